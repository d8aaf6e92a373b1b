"""Tiles of failures: outlines where the poses are, whatever the pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_frames import CAMERA, LAYOUT, frame_of, moved

from cad.spatial import transform
from perception.failure_sheet import BORDER_PX, CAPTION_PX, RED, TILE_PX, Failure, PosedPart, failure_tile
from perception.silhouette import silhouette_mask


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return frame_of(tmp_path_factory.mktemp("frames") / "data", LAYOUT)


def failure(true=None, estimated=None, **changes):
    return Failure(
        **({"caption": ("kind", "where"), "accepted": False, "true": true, "estimated": estimated} | changes)
    )


def coloured(tile, channel):
    """Pixels of the picture in which one of red and green stands out."""
    picture = tile[BORDER_PX : BORDER_PX + TILE_PX, BORDER_PX:-BORDER_PX].astype(int)
    return picture[..., channel] - picture[..., 1 - channel] > 60


def test_the_true_outline_lies_on_the_part_in_the_frame(truth):
    part = truth.parts[1]
    mask, (u, v) = silhouette_mask(part.part, part.T_cam_part, CAMERA)
    frame = truth.frame()
    image = frame.image.copy()
    image[v : v + mask.shape[0], u : u + mask.shape[1]][mask] = 250
    tile = failure_tile(replace(frame, image=image), failure(PosedPart(part=part.part, T_cam_part=part.T_cam_part)))
    assert tile.shape == (TILE_PX + CAPTION_PX + 2 * BORDER_PX, TILE_PX + 2 * BORDER_PX, 3)
    green = coloured(tile, 1)
    rows, columns = np.nonzero(green)
    grey = tile[BORDER_PX : BORDER_PX + TILE_PX, BORDER_PX:-BORDER_PX]
    bright = np.argwhere(grey.min(axis=2) > 200)
    np.testing.assert_allclose([rows.min(), columns.min()], bright.min(axis=0), atol=2)
    np.testing.assert_allclose([rows.max(), columns.max()], bright.max(axis=0), atol=2)


def test_a_shifted_estimate_is_drawn_in_red_beside_the_truth(truth):
    part = truth.parts[0]
    true = PosedPart(part=part.part, T_cam_part=part.T_cam_part)
    shifted = PosedPart(part=part.part, T_cam_part=moved(part, x_m=2e-3))
    tile = failure_tile(truth.frame(), failure(true, shifted, accepted=True))
    red, green = np.nonzero(coloured(tile, 0)), np.nonzero(coloured(tile, 1))
    px_a_m = TILE_PX / 0.017
    assert red[1].max() - green[1].max() == pytest.approx(2e-3 * px_a_m, abs=3)
    assert (tile[0, 0] == RED).all() and not (failure_tile(truth.frame(), failure(true))[0, 0] == RED).all()


@pytest.mark.parametrize("T", [transform(None, [0, 0, z]) for z in (-0.5, 1e-9, 0.004, 90.0)])
def test_raw_poses_at_any_distance_make_a_tile(truth, T):
    wild = PosedPart(part=truth.parts[0].part, T_cam_part=T)
    assert failure_tile(truth.frame(), failure(estimated=wild)).shape[1] == TILE_PX + 2 * BORDER_PX
    true = PosedPart(part=truth.parts[0].part, T_cam_part=truth.parts[0].T_cam_part)
    assert coloured(failure_tile(truth.frame(), failure(true, wild)), 1).any()


def test_a_failure_of_nothing_is_an_error(truth):
    with pytest.raises(ValueError, match="neither a true nor an estimated pose"):
        failure_tile(truth.frame(), failure())
