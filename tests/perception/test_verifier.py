import numpy as np
import torch

from cad.spatial import wrap_angle
from perception.augment import CROP_CENTRE, image_turn
from perception.faces import FaceTable
from perception.labels import CropLabels
from perception.verifier import RECTIFIED, PairSampler, Verifier, listwise, rectify, score_views, verifier_loss

TABLE = FaceTable.load(["top"])


def arrow(yaw: float, centre) -> np.ndarray:
    """A crop with a bright bar from ``centre`` along ``yaw`` (table y is up in the picture)."""
    v, u = np.mgrid[0:128, 0:128]
    along = (u - centre[0]) * np.cos(yaw) - (v - centre[1]) * np.sin(yaw)
    across = (u - centre[0]) * np.sin(yaw) + (v - centre[1]) * np.cos(yaw)
    bar = (along > 0) & (along < 25) & (np.abs(across) < 4)
    return np.repeat(np.where(bar, 220, 40).astype(np.uint8)[..., None], 3, axis=2)


def labels_of(faces) -> CropLabels:
    n, rng = len(faces), np.random.default_rng(0)
    return CropLabels(
        face=np.array(faces),
        yaw=rng.uniform(-np.pi, np.pi, n),
        centre=np.full((n, 2), CROP_CENTRE),
        ray=np.full((n, 2), 0.1),
        keypoints=np.zeros((n, 1, 8, 2)),
    )


def test_rectifying_turns_any_yaw_to_zero_about_the_centre() -> None:
    for yaw in (-2.5, 0.0, 0.4, 3.0):
        centre, ray = np.array([58.0, 70.0]), np.array([0.1, 0.0])
        view, turned = rectify(arrow(yaw, centre), centre, yaw, ray)
        v, u = np.nonzero(view[..., 0] > 130)
        middle = (RECTIFIED - 1) / 2
        assert abs(u.mean() - middle - 12.5) < 1.0 and abs(v.mean() - middle) < 1.0
        assert np.allclose(turned, image_turn(-yaw) @ ray)


def test_pairs_hold_the_upright_view_and_targets_sum_to_one() -> None:
    labels = labels_of([0, 1, 2, -1] * 5)
    images = np.stack([arrow(yaw, centre) for yaw, centre in zip(labels.yaw, labels.centre, strict=True)])
    views, rays, target = PairSampler(TABLE)(images, labels, np.random.default_rng(1))
    assert views.shape == (40, RECTIFIED, RECTIFIED, 3) and np.allclose(np.linalg.norm(rays, axis=1), np.sqrt(0.02))
    assert np.allclose(target.sum(axis=1), 1.0)
    along = []
    for i in np.flatnonzero(labels.has_part):
        view, face = divmod(int(target[i].argmax()), len(TABLE))
        assert face == labels.face[i]
        along.append(np.nonzero(views[2 * i + view][..., 0] > 130)[1].mean() - (RECTIFIED - 1) / 2)
    assert abs(np.median(along) - 12.5) < 2.0  # the bar points along +x in the views that are called upright
    assert (target[~labels.has_part, -1] == 1.0).all()


def test_listwise_is_a_distribution_whatever_the_number_of_views() -> None:
    for views in (2, 4):
        log = listwise(torch.randn(3, views, 6, generator=torch.Generator().manual_seed(0)))
        assert log.shape == (3, views * 5 + 1)
        assert torch.allclose(log.exp().sum(1), torch.ones(3))


def test_loss_is_least_for_the_target_itself() -> None:
    labels = labels_of([0, 2, -1])
    sampler = PairSampler(TABLE)
    _, _, target = sampler(np.zeros((3, 128, 128, 3), np.uint8), labels, np.random.default_rng(2))
    inside = torch.from_numpy(sampler.within_part(labels))
    wanted = torch.from_numpy(target)
    best = sum(verifier_loss(torch.log(wanted + 1e-9), wanted, inside).values())
    flat = sum(verifier_loss(torch.full_like(wanted, -3.0), wanted, inside).values())
    assert float(best) < 1e-3 < 1.0 < float(flat)


def test_scores_of_a_batch_are_those_of_its_crops() -> None:
    torch.manual_seed(0)
    model = Verifier(5).eval()
    views = np.random.default_rng(3).integers(0, 255, (6, RECTIFIED, RECTIFIED, 3), dtype=np.uint8)
    rays = np.zeros((6, 2))
    together = score_views(model, views, rays, [4, 2])
    alone = score_views(model, views[4:], rays[4:], [2])
    assert together[0][0].shape == (4, 5) and together[1][0].shape == (2, 5)
    assert np.allclose(together[1][0], alone[0][0], atol=0.05)
    assert np.isclose(np.exp(alone[0][0]).sum() + np.exp(alone[0][1]), 1.0)


def test_half_a_turn_more_swaps_the_views() -> None:
    centre = np.array([CROP_CENTRE] * 2)
    image = arrow(1.0, centre)
    a, _ = rectify(image, centre, 1.0, np.zeros(2))
    b, _ = rectify(image, centre, float(wrap_angle(1.0 + np.pi)), np.zeros(2))
    assert np.abs(a.astype(int) - b[::-1, ::-1]).mean() < 2.0
