import numpy as np
import torch

from perception.pvnet import (
    GRID,
    OFFSET_SCALE_PX,
    PVNet,
    at_cells,
    grid_pixels,
    infer_votes,
    pvnet_loss,
    sample_cells,
)


def model(n_faces: int = 3) -> PVNet:
    torch.manual_seed(0)
    return PVNet(n_faces)


def test_a_cell_is_the_middle_of_two_by_two_pixels() -> None:
    cells = torch.tensor([0, 1, GRID, GRID * GRID - 1])
    assert grid_pixels(cells).tolist() == [[0.5, 0.5], [2.5, 0.5], [0.5, 2.5], [126.5, 126.5]]


def test_features_are_read_at_their_cells() -> None:
    features = torch.randn(2, 7, GRID, GRID, generator=torch.Generator().manual_seed(1))
    cells = torch.tensor([[5, 70], [4095, 64]])
    read = at_cells(features, cells)
    assert torch.equal(read[0, 1], features[0, :, 1, 6]) and torch.equal(read[1, 0], features[1, :, 63, 63])


def test_sampled_cells_lie_on_the_mask() -> None:
    masks = np.zeros((2, GRID, GRID), dtype=bool)
    masks[0, 10:13, 20:24] = True
    cells = sample_cells(masks, 50, np.random.default_rng(0))
    assert masks[0].ravel()[cells[0]].all() and cells.shape == (2, 50)


def test_shapes_and_units_of_votes() -> None:
    net = model()
    features, mask = net(torch.zeros(2, 5, 128, 128))
    assert features.shape[2:] == (GRID, GRID) and mask.shape == (2, GRID, GRID)
    unit, offset, log_scale = net.votes(torch.randn(2, 9, features.shape[1]), torch.tensor([0, 2]))
    assert unit.shape == offset.shape == (2, 9, 8, 2) and log_scale.shape == (2, 9, 8)
    assert torch.allclose(unit.norm(dim=-1), torch.ones(2, 9, 8), atol=1e-4)


def test_each_face_has_its_own_head() -> None:
    net = model()
    features = torch.randn(1, 4, 40)
    a, b = (net.votes(features, torch.tensor([face]))[1] for face in (0, 1))
    assert not torch.allclose(a, b)
    with torch.no_grad():
        net.head[1] = net.head[0]
        net.head_bias[1] = net.head_bias[0]
    assert torch.allclose(a, net.votes(features, torch.tensor([1]))[1])


def test_the_loss_takes_the_alternative_that_fits_and_leaves_out_crops_without_part() -> None:
    net = model()
    with torch.no_grad():
        net.head.zero_()
        net.head_bias.view(3, 8, 5)[..., 2:4] = torch.tensor([20.0, -10.0]) / OFFSET_SCALE_PX
        net.head_bias.view(3, 8, 5)[..., :2] = torch.tensor([2.0, -1.0])
    x, mask = torch.zeros(2, 5, 128, 128), torch.zeros(2, GRID, GRID)
    cells = torch.full((2, 6), 2080)
    at = grid_pixels(torch.tensor(2080))
    fits = (at + torch.tensor([20.0, -10.0])).expand(8, 2)
    keypoints = torch.stack([torch.stack([fits + 40.0, fits]), torch.full((2, 8, 2), 999.0)])
    with torch.no_grad():
        losses = pvnet_loss(net, x, mask, torch.tensor([1, -1]), keypoints, cells)
    assert float(losses["vector"]) < 1e-5 and abs(float(losses["offset"])) < 1e-4


def test_training_on_one_crop_places_its_keypoints() -> None:
    net = model(1).train()
    rng = np.random.default_rng(5)
    x = torch.from_numpy(rng.normal(size=(2, 5, 128, 128)).astype(np.float32))
    mask = torch.zeros(2, GRID, GRID)
    mask[:, 20:40, 24:44] = 1.0
    keypoints = torch.from_numpy(rng.uniform(40, 90, (1, 1, 8, 2)).astype(np.float32)).expand(2, 1, 8, 2)
    optimizer = torch.optim.AdamW(net.parameters(), lr=5e-3)
    face = torch.zeros(2, dtype=torch.int64)
    first = last = 0.0
    for step in range(10):
        cells = torch.from_numpy(sample_cells(mask.numpy() > 0.5, 64, rng))
        losses = pvnet_loss(net, x, mask, face, keypoints, cells)
        last = losses["offset"].item()
        first = last if step == 0 else first
        optimizer.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        optimizer.step()
    assert last < 0.8 * first


def test_inference_returns_votes_of_a_bounded_number_of_pixels() -> None:
    net = model().eval()
    images = np.random.default_rng(6).integers(0, 255, (2, 128, 128, 3), dtype=np.uint8)
    with torch.no_grad():
        net.mask.bias.fill_(20.0)  # all of the picture
    votes = infer_votes(net, images, np.zeros((2, 2)), np.array([0, 2]), most_pixels=100)
    assert [len(v["pixels"]) for v in votes] == [100, 100] and votes[0]["unit"].shape == (100, 8, 2)
    with torch.no_grad():
        net.mask.bias.fill_(-20.0)  # none of it
    assert [len(v["pixels"]) for v in infer_votes(net, images, np.zeros((2, 2)), np.array([0, 2]))] == [16, 16]
