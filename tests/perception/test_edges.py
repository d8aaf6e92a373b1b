import cv2
import numpy as np
import pytest

from cad.parts import Part, load_part, planar
from cad.spatial import BASLER, rotation_x, transform
from perception.edges import MAX_PATCHES, PATCH_OFFSETS_M, SAMPLE_STEP_M, visible_edges
from perception.silhouette import render_view
from perception.table_camera import TableCamera

UP = np.array([0.0, 0.0, 1.0])
CAMERA = BASLER.crop(2736 - 128, 1824 - 128, 256, 256)
T_CAM_TABLE = transform(rotation_x(np.pi), [0.0, 0.0, 0.7])


def test_a_box_from_above_shows_its_outline_once(plain_box: Part) -> None:
    samples = visible_edges(plain_box, 0, UP)
    assert samples.outline.all()
    assert len(samples.points) * SAMPLE_STEP_M == pytest.approx(28e-3, abs=5e-4)  # 2 (8 + 6) mm, not the lower edges
    assert samples.points[:, 2] == pytest.approx(2e-3, abs=1e-9)


def test_a_box_seen_aslant_shows_its_wall_too(plain_box: Part) -> None:
    samples = visible_edges(plain_box, 0, np.array([0.3, 0.0, 1.0]))
    inner = samples.points[~samples.outline]
    assert inner[:, 0] == pytest.approx(4e-3, abs=1e-6)  # the upper edge of the wall that faces the camera
    low = samples.points[samples.outline & (samples.points[:, 2] < 1e-4)]
    assert (low[:, 0] > 3.9e-3).all()  # and its lower one is the outline there


def test_covered_edges_are_left_out(stepped: Part) -> None:
    flipped = visible_edges(stepped, 1, UP)
    assert (flipped.points[:, 2] > 2e-3).all()  # the blocks are under the plate
    upright = visible_edges(stepped, 0, UP)
    tops = upright.points[~upright.outline & (upright.points[:, 2] > 1.3e-3)]
    assert len(tops) * SAMPLE_STEP_M > 10e-3  # both blocks' upper edges show inside the plate's outline


@pytest.mark.parametrize("name", ["inserted", "main", "top"])
def test_outlines_lie_on_the_border_of_the_mask(name: str) -> None:
    part = load_part(name)
    for k in range(len(part.stable_poses)):
        pose = np.array([0.0003, -0.0005, 0.6])
        camera = TableCamera(intrinsics=CAMERA, T_cam_table=T_CAM_TABLE)
        samples = visible_edges(part, k, camera.eye(pose))
        mask = render_view(part, T_CAM_TABLE @ planar(*pose) @ part.stable_poses[k].T_table_part, CAMERA).mask
        pixels, _, _ = camera.project(samples, pose)
        signed = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) + cv2.distanceTransform(
            1 - mask.astype(np.uint8), cv2.DIST_L2, 5
        )
        u, v = np.round(pixels[samples.outline]).astype(int).T
        assert np.percentile(signed[v, u], 98) <= 2.3


def test_patches_are_what_lies_on_either_side(plain_box: Part) -> None:
    samples = visible_edges(plain_box, 0, UP)
    middle = len(PATCH_OFFSETS_M) // 2
    long_edge = (np.abs(samples.points[:, 0]) < 3e-3) & (samples.points[:, 1] > 0)
    patches = samples.patches[long_edge]
    assert patches.max() < MAX_PATCHES
    assert all(len(np.unique(row)) == 2 for row in patches)  # box and background
    change = np.argmax(patches[:, 1:] != patches[:, :-1], axis=1)
    assert (np.abs(change - middle) <= 2).all()


def test_unknown_faces_and_cameras_below_the_table_are_errors(plain_box: Part) -> None:
    with pytest.raises(IndexError, match="1 stable poses"):
        visible_edges(plain_box, 1, UP)
    with pytest.raises(ValueError, match="below the table"):
        visible_edges(plain_box, 0, -UP)
