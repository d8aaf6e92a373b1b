import numpy as np
import pytest
import torch

from perception.estimates import PerceptionError
from perception.pvnet import GRID, PVNet
from perception.pvnet_baseline_net import Pvnets, baseline_loss, unit_vectors, vote_keypoints


@pytest.fixture(scope="module")
def nets() -> Pvnets:
    torch.manual_seed(0)
    return Pvnets({"a": 8, "b": 8}).eval()


def test_targets_point_to_the_keypoints_at_unit_length() -> None:
    keypoints = torch.tensor([[[10.5, 0.5], [0.5, -30.5]]])
    towards = unit_vectors(keypoints, torch.tensor([[0]]))
    assert torch.allclose(towards, torch.tensor([[[[1.0, 0.0], [0.0, -1.0]]]]))


def test_each_part_has_its_own_decoder(nets: Pvnets) -> None:
    maps = nets.encoder(torch.randn(1, 5, 128, 128))
    a, b = (nets.decoder(part)(maps) for part in ("a", "b"))
    assert a[0].shape == b[0].shape and a[0].shape[2:] == (GRID, GRID) and a[1].shape == (1, GRID, GRID)
    assert not torch.allclose(a[0], b[0])
    assert nets.decoder("a").vectors(torch.zeros(1, 5, a[0].shape[1])).shape == (1, 5, 8, 2)


def test_the_loss_vanishes_for_perfect_answers_and_not_for_others() -> None:
    nets = Pvnets({"a": 8, "b": 8}).eval()
    with torch.no_grad():
        for part in ("a", "b"):
            decoder = nets.decoder(part)
            for layer in (decoder.head, decoder.mask):
                layer.weight.zero_()
            assert decoder.mask.bias is not None
            decoder.mask.bias.fill_(30.0)
            decoder.head.bias.copy_(torch.tensor([1.0, 0.0]).repeat(8))  # everything points right
    parts, cells = {"a": slice(0, 1), "b": slice(1, 2)}, torch.randint(GRID * GRID, (2, 20))
    right = torch.tensor([1e6, 64.0]).expand(2, 8, 2)
    below = torch.tensor([64.0, 1e6]).expand(2, 8, 2)
    x, full = torch.zeros(2, 5, 128, 128), torch.ones(2, GRID, GRID)
    with torch.no_grad():
        perfect = baseline_loss(nets, parts, x, full, right, cells)
        turned = baseline_loss(nets, parts, x, full, below, cells)
        unmasked = baseline_loss(nets, parts, x, 0 * full, right, cells)
    assert float(perfect["mask"]) < 1e-6 and float(perfect["vector"]) < 1e-6
    assert float(turned["vector"]) == pytest.approx(0.5, abs=1e-3)  # both components are off by one
    assert float(unmasked["mask"]) > 10


def test_one_part_learns_only_from_its_own_crops() -> None:
    nets = Pvnets({"a": 8, "b": 8})
    keypoints, cells = torch.rand(2, 8, 2) * 128, torch.randint(GRID * GRID, (2, 20))
    losses = baseline_loss(
        nets, {"a": slice(0, 2)}, torch.randn(2, 5, 128, 128), torch.ones(2, 64, 64), keypoints, cells
    )
    (losses["mask"] + losses["vector"]).backward()
    assert nets.decoder("a").head.weight.grad is not None and nets.decoder("b").head.weight.grad is None
    assert nets.encoder.down1[0].weight.grad is not None


def test_the_start_takes_all_but_the_heads(nets: Pvnets) -> None:
    votes = PVNet(3).state_dict()
    started = Pvnets({"a": 8, "b": 8})
    head = started.decoder("a").head.weight.clone()
    started.start_from(votes)
    state = started.state_dict()
    assert torch.equal(state["encoder.down3.0.0.weight"], votes["down3.0.0.weight"])
    assert torch.equal(state["decoders.a.up2.0.weight"], state["decoders.b.up2.0.weight"])
    assert torch.equal(state["decoders.a.up2.0.weight"], votes["up2.0.weight"])
    assert torch.equal(state["decoders.a.head.weight"], head)
    again = Pvnets({"a": 8, "b": 8})
    again.start_from(state)
    assert torch.equal(again.decoder("a").head.weight, head)
    with pytest.raises(PerceptionError, match=r"no down1.*keypoints.safetensors"):
        started.start_from({"features.0.weight": torch.zeros(1)})


def test_there_is_an_answer_even_where_the_mask_is_empty() -> None:
    nets = Pvnets({"a": 8}).eval()
    images = np.random.default_rng(0).integers(0, 255, (2, 128, 128, 3), dtype=np.uint8)
    for bias in (-20.0, 20.0):
        with torch.no_grad():
            mask = nets.decoder("a").mask.bias
            assert mask is not None
            mask.fill_(bias)
        found = vote_keypoints(nets, "a", images, np.zeros((2, 2)), np.random.default_rng(1))
        assert len(found) == 2 and found[0].pixels.shape == (8, 2) and np.isfinite(found[1].pixels).all()
        assert found[0].mask.shape == (GRID, GRID) and (found[0].mask.mean() > 0.5) == (bias > 0)
    assert vote_keypoints(nets, "a", images[:0], np.zeros((0, 2)), np.random.default_rng(1)) == []
