import cv2
import numpy as np
import pytest

from cad.tagboard import DICTIONARY, TagboardConfig, TagboardError, label_image


def test_default_ring_leaves_room_for_the_parts():
    board = TagboardConfig()
    assert 20 <= len(board.ids) <= 28
    half_x, half_y = board.free_half_extents_m
    assert 2 * half_x >= 0.170
    assert 2 * half_y >= 0.110
    corners = np.array([board.corners(i) for i in board.ids])
    assert np.abs(corners[..., 0]).max() < board.width_m / 2
    assert np.abs(corners[..., 1]).max() < board.height_m / 2
    inside = (np.abs(corners[..., 0]) < half_x) & (np.abs(corners[..., 1]) < half_y)
    assert not inside.any()


def test_opencv_detects_every_tag_where_corners_says():
    board, scale = TagboardConfig(), 5000.0
    image = cv2.copyMakeBorder(board.texture(scale), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=(128, 128, 128))
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY))
    found, ids, _ = detector.detectMarkers(image)
    assert sorted(ids.ravel().tolist()) == list(board.ids)
    for corners, tag_id in zip(found, ids.ravel(), strict=True):
        truth = board.corners(int(tag_id))[:, :2]
        u = (truth[:, 0] + board.width_m / 2) * scale - 0.5 + 40
        v = (board.height_m / 2 - truth[:, 1]) * scale - 0.5 + 40
        assert np.abs(corners[0] - np.stack([u, v], -1)).max() < 1.6  # whole pixels: the detector was not refined


def test_texture_takes_a_background_picture():
    background = np.zeros((11, 16, 3), np.uint8)
    background[..., 0] = 200
    texture = TagboardConfig().texture(1000.0, background)
    assert texture.shape == (220, 320, 3)
    assert texture[110, 160].tolist() == [200, 0, 0]


def test_label_has_a_quiet_zone_of_one_cell():
    label = label_image(7, 4)
    assert label.shape == (40, 40)
    assert label[:4].min() == 255
    assert label[4:8, 4:-4].max() == 0


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"columns": 1}, "at least 2 columns"),
        ({"columns": 12}, "overlap"),
        ({"first_id": 580}, "are not all in"),
        ({"tag_m": -0.01}, "must be positive"),
    ],
)
def test_impossible_boards_are_refused(settings, says):
    with pytest.raises(TagboardError, match=says):
        TagboardConfig(**settings)


def test_unknown_tag_names_the_ids_there_are():
    with pytest.raises(TagboardError, match=r"ids are 0\.\.25"):
        TagboardConfig().corners(99)
