import numpy as np
import pytest
import torch

from cad.parts import planar
from cad.spatial import BASLER, apply, rotation_from_rotvec, rotation_x, transform, wrap_angle
from perception.augment import (
    CROP_CENTRE,
    Photometric,
    crop_warp,
    image_turn,
    network_input,
    warp_image,
    warp_points,
)
from perception.calibration import table_from_board
from perception.classifier import (
    BIN_CENTRES,
    YAW_BINS,
    JointClassifier,
    SoftLabels,
    classifier_loss,
    classify,
    modes,
)
from perception.dataset import CropSet
from perception.faces import FaceTable
from perception.labels import CropLabels, label_crops
from perception.planar import on_plane
from perception.silhouette import render_view

TABLE = FaceTable.load(["top"])
T_CAM_BOARD = transform(rotation_from_rotvec([0.01, -0.008, 0.02]) @ rotation_x(np.pi), [0.002, -0.003, 0.705])


def crop_set(rng: np.random.Generator, count: int) -> CropSet:
    """Silhouettes of random faces; the last crop is empty."""
    camera, fields = BASLER.crop(3300, 1100, 256, 256).downscaled(2), []
    T_cam_table = table_from_board(T_CAM_BOARD)
    for i in range(count):
        face = TABLE[int(rng.integers(len(TABLE)))]
        x, y, _ = on_plane(rng.uniform(55, 72, 2), 0.0, camera, T_cam_table)
        T = T_cam_table @ planar(x, y, rng.uniform(-np.pi, np.pi)) @ face.stable_pose.T_table_part
        mask = render_view(face.part, T, camera).mask if i + 1 < count else np.zeros((128, 128), dtype=bool)
        fields.append((face.part.obj_id if i + 1 < count else 0, face.stable_pose.index, T, mask))
    obj_id, pose, T, mask = (np.array(column) for column in zip(*fields, strict=True))
    return CropSet(
        images=np.repeat(np.where(mask, 200, 60).astype(np.uint8)[..., None], 3, axis=3),
        obj_id=obj_id,
        stable_pose=pose,
        T_cam_part=T,
        T_cam_board=np.tile(T_CAM_BOARD, (count, 1, 1)),
        K=np.tile(camera.matrix, (count, 1, 1)),
        packed_masks=np.packbits(mask, axis=-1),
    )


def labels_at(face, yaw) -> CropLabels:
    n = len(face)
    return CropLabels(
        face=np.asarray(face),
        yaw=np.asarray(yaw, dtype=float),
        centre=np.full((n, 2), CROP_CENTRE),
        ray=np.zeros((n, 2)),
        keypoints=np.zeros((n, 1, 8, 2)),
    )


def test_labels_rebuild_the_pose_they_came_from() -> None:
    crops = crop_set(np.random.default_rng(0), 12)
    labels = label_crops(TABLE, crops)
    camera, T_cam_table = BASLER.crop(3300, 1100, 256, 256).downscaled(2), table_from_board(T_CAM_BOARD)
    assert labels.has_part.tolist() == [True] * 11 + [False]
    for i in range(11):
        face = TABLE[int(labels.face[i])]
        x, y, _ = on_plane(labels.centre[i], face.middle_m, camera, T_cam_table)
        T = T_cam_table @ planar(x, y, labels.yaw[i]) @ face.stable_pose.T_table_part
        assert np.allclose(T, crops.T_cam_part[i], atol=1e-9)
        assert np.allclose(camera.project(apply(T, face.part.keypoints)), labels.keypoints[i, 0], atol=1e-6)


def test_labels_stay_true_when_the_crop_is_turned() -> None:
    """Turning the picture is turning the camera about its axis: the turned label draws the turned silhouette."""
    rng = np.random.default_rng(1)
    crops = crop_set(rng, 6)
    labels = label_crops(TABLE, crops)
    for i in range(5):
        angle, shift = rng.uniform(0.5, 5.5), rng.uniform(-3, 3, 2)
        warp = crop_warp(angle, shift)
        turned = labels.take(np.array([i])).warped(warp[None], np.array([angle]))
        camera = BASLER.crop(3300, 1100, 256, 256).downscaled(2)
        cx, cy = warp_points(warp, [camera.cx, camera.cy])
        camera = type(camera)(width=128, height=128, fx=camera.fx, fy=camera.fy, cx=cx, cy=cy)
        turn = np.eye(4)
        turn[:2, :2] = image_turn(angle)
        T_cam_table = table_from_board(turn @ T_CAM_BOARD)
        face = TABLE[int(turned.face[0])]
        x, y, _ = on_plane(turned.centre[0], face.middle_m, camera, T_cam_table)
        T = T_cam_table @ planar(x, y, turned.yaw[0]) @ face.stable_pose.T_table_part
        drawn = render_view(face.part, T, camera).mask
        seen = warp_image(crops.images[i], warp)[..., 0] > 130
        assert (drawn & seen).sum() / (drawn | seen).sum() > 0.93
        assert np.allclose(turned.ray[0], camera.rays([CROP_CENTRE] * 2)[:2], atol=2e-3)
        assert np.allclose(camera.project(apply(T, face.part.keypoints)), turned.keypoints[0, 0], atol=0.3)


def test_soft_labels_are_distributions_centred_on_the_yaw() -> None:
    soft = SoftLabels(TABLE)
    labels = labels_at([0, 2, -1], [0.3, -2.0, 0.0])
    target = soft(labels)
    assert np.allclose(target.sum(axis=1), 1.0, atol=1e-5) and target[2, -1] == 1.0
    grid = target[:2, :-1].reshape(2, len(TABLE), YAW_BINS)
    for row, (face, yaw) in enumerate([(0, 0.3), (2, -2.0)]):
        mean = np.angle((grid[row, face] * np.exp(1j * BIN_CENTRES)).sum())
        assert abs(float(wrap_angle(mean - yaw))) < np.radians(1.5)
    inside = soft.within_part(labels)
    assert (target[~inside] == 0).all() and inside[2].sum() == 1


def test_the_loss_is_least_for_the_target_itself() -> None:
    soft = SoftLabels(TABLE)
    labels = labels_at([1, 2, -1], [1.0, 2.0, 0.0])
    target, inside = torch.from_numpy(soft(labels)), torch.from_numpy(soft.within_part(labels))
    centre = torch.zeros(3, 2)

    def loss(logits):
        return float(sum(classifier_loss(logits, centre, target, inside, centre).values()))

    assert loss(torch.log(target + 1e-9)) == pytest.approx(0.0, abs=1e-3)
    assert loss(torch.zeros_like(target)) > 3.0


def test_modes_find_yaws_between_bins() -> None:
    probability = np.full((3, YAW_BINS), 1e-6)
    probability[1, [35, 0]] = 0.3  # midway: at yaw 0
    probability[2, 9] = 0.35
    found = modes(np.log(probability), 2)
    assert found[0][0] == 1 and abs(found[0][1]) < 1e-3 and found[0][2] == pytest.approx(np.log(0.6), abs=1e-3)
    assert found[1][0] == 2 and found[1][1] == pytest.approx(BIN_CENTRES[9], abs=1e-3)


def test_averaging_over_quarter_turns_is_equivariant() -> None:
    torch.manual_seed(0)
    model = JointClassifier(4).eval()
    rng = np.random.default_rng(2)
    images, rays = rng.integers(0, 255, (2, 128, 128, 3), dtype=np.uint8), rng.normal(0, 0.05, (2, 2))
    upright = classify(model, images, rays)
    turned = classify(model, np.ascontiguousarray(np.rot90(images, 1, axes=(1, 2))), rays @ image_turn(np.pi / 2).T)
    shifted = np.roll(upright.log_probability, YAW_BINS // 4, axis=2)
    assert np.allclose(turned.log_probability, shifted, atol=0.02)
    assert np.allclose(turned.centre - CROP_CENTRE, (upright.centre - CROP_CENTRE) @ image_turn(np.pi / 2).T, atol=0.1)
    with pytest.raises(ValueError, match="quarter_turns = 3"):
        classify(model, images, rays, 3)


def test_network_input_does_not_depend_on_exposure() -> None:
    image = np.random.default_rng(3).integers(20, 110, (1, 128, 128, 3), dtype=np.uint8)
    a, b = (network_input(i, np.array([[0.1, -0.2]])) for i in (image, 2 * image))
    assert a.shape == (1, 5, 128, 128) and a.is_contiguous(memory_format=torch.channels_last)
    assert float((a - b)[:, :3].abs().mean()) < 0.15
    assert torch.allclose(a[0, 3:, 5, 7], torch.tensor([0.5, -1.0]))


def test_photometric_changes_repeat_with_the_generator_and_keep_the_ray() -> None:
    images = np.random.default_rng(4).integers(0, 255, (3, 128, 128, 3), dtype=np.uint8)
    rays = np.tile([0.1, 0.2], (3, 1))
    vary = Photometric(np.random.default_rng(0), 1 << 17)
    a, b, c = (vary(images, rays, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert torch.equal(a, b) and not torch.equal(a, c)
    assert torch.allclose(a[:, 3:], c[:, 3:])
