import cv2
import numpy as np
import pytest

from cad.parts import Part, planar
from perception.region import region_scores
from perception.silhouette import render_view


@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("truth", [0, 1])
def test_the_true_pose_scores_above_flipped_ones(stepped: Part, picture_of, truth: int, seed: int) -> None:
    picture = picture_of(stepped, truth, seed)
    half = cv2.resize(picture.gray, (128, 128), interpolation=cv2.INTER_AREA)
    labels = []
    for face, turn in ((truth, 0.0), (truth, np.pi), (1 - truth, 0.0), (1 - truth, np.pi)):
        T_table_part = planar(picture.x, picture.y, picture.yaw + turn) @ stepped.stable_poses[face].T_table_part
        labels.append(render_view(stepped, picture.T_cam_table @ T_table_part, picture.intrinsics.downscaled(2)).facet)
    fits = [score.fit for score in region_scores(half, labels)]
    best = int(np.argmax(fits))
    assert best == 0 or (truth == 1 and best == 1)  # upside down the plate hides all that tells its ends apart


def test_edges_inside_that_nothing_explains_count_against_a_pose(stepped: Part, picture_of) -> None:
    picture = picture_of(stepped, 0, seed=14)
    half = cv2.resize(picture.gray, (128, 128), interpolation=cv2.INTER_AREA)
    labels = []
    for face in (0, 1):  # upside down, the plate is plain and explains none of the blocks' edges
        T_table_part = planar(picture.x, picture.y, picture.yaw) @ stepped.stable_poses[face].T_table_part
        labels.append(render_view(stepped, picture.T_cam_table @ T_table_part, picture.intrinsics.downscaled(2)).facet)
    right, wrong = region_scores(half, labels)
    assert wrong.unexplained > right.unexplained


def test_scores_do_not_depend_on_the_order() -> None:
    rng = np.random.default_rng(0)
    gray = rng.integers(0, 255, (40, 50)).astype(np.uint8)
    labels = [np.full((40, 50), -1, np.int32) for _ in range(2)]
    labels[0][5:20, 5:30], labels[1][10:30, 20:45] = 0, 3
    forward, backward = region_scores(gray, labels), region_scores(gray, labels[::-1])
    assert forward == backward[::-1]
    assert region_scores(gray, []) == []


def test_a_map_of_another_size_is_an_error() -> None:
    with pytest.raises(ValueError, match="same size"):
        region_scores(np.zeros((10, 10), np.uint8), [np.zeros((5, 5), np.int32)])
