"""The contact sheet: every row shows an effect, captions stay beside the tiles, and it can be written."""

import itertools

import cv2
import numpy as np
import pytest

from scenes.contact_sheet import CAPTION_PX, DRAWN_ROWS, GAP_PX, ROWS, contact_sheet, write_contact_sheet
from scenes.dataset_config import DatasetConfig
from scenes.errors import SceneError
from scenes.ranges import LookRanges, SensorRanges, ViewRanges
from scenes.sheet_rows import COLUMNS, TILE, ends, middle

CONFIG = DatasetConfig(kind="crop", parts=("inserted", "main"))


@pytest.fixture(scope="module")
def sheet():
    shares = []
    image = contact_sheet(CONFIG, progress=shares.append)
    return image, shares


def tiles_of(image):
    """All rows of tiles, in order: (rows, COLUMNS, TILE, TILE, 3)."""
    width = CAPTION_PX + COLUMNS * (TILE + GAP_PX)
    rows = []
    for left, top in itertools.product((0, width), range(0, image.shape[0], TILE + GAP_PX)):
        strip = image[top : top + TILE, left : left + width]
        rows.append([strip[:, CAPTION_PX + k * (TILE + GAP_PX) :][:, :TILE] for k in range(COLUMNS)])
    return np.array([row for row in rows if (np.array(row) < 255).any()])


def test_every_row_shows_what_its_range_does(sheet):
    rows = tiles_of(sheet[0]).astype(int)
    assert len(rows) == ROWS + DRAWN_ROWS
    for k, row in enumerate(rows):
        assert np.abs(row[0] - row[-1]).mean() > 0.3, k
        assert 5 < row.mean() < 250, k


def test_captions_are_written_beside_the_tiles(sheet):
    image, _ = sheet
    for left in (0, CAPTION_PX + COLUMNS * (TILE + GAP_PX)):
        caption = image[:, left : left + CAPTION_PX]
        assert (caption < 100).any()
        assert (caption[:, -2:] == 255).all(), "a caption runs into the tiles"


def test_progress_rises_to_the_end(sheet):
    _, shares = sheet
    assert shares == sorted(shares) and shares[-1] == 1.0 and shares[0] < 0.1


def test_a_sheet_that_is_no_picture_is_refused_before_anything_is_drawn(tmp_path):
    with pytest.raises(SceneError, match=r"sheet\.txt: a contact sheet is a picture"):
        write_contact_sheet(CONFIG, tmp_path / "sheet.txt")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_sheet_is_written(tmp_path, monkeypatch, sheet, suffix):
    monkeypatch.setattr("scenes.contact_sheet.contact_sheet", lambda config, progress: sheet[0])
    out = tmp_path / "deep" / f"sheet{suffix}"
    write_contact_sheet(CONFIG, out)
    read = cv2.imread(str(out))[..., ::-1].astype(int)
    assert np.abs(read - sheet[0]).mean() < 6
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(SceneError, match="cannot write"):
        write_contact_sheet(CONFIG, blocked / f"sheet{suffix}")


@pytest.mark.parametrize("ranges", [LookRanges(), SensorRanges(), ViewRanges()])
def test_the_middle_of_ranges_has_no_extent(ranges):
    for name, value in vars(middle(ranges)).items():
        if isinstance(value, tuple):
            low, high = getattr(ranges, name)
            assert value[0] == value[1] and low <= value[0] <= high
        else:
            assert value == (1.0 if name == "shadow_share" else 0.0)


def test_a_row_goes_from_low_to_high():
    values = ends((2.0, 7.0))
    assert len(values) == COLUMNS and values[0] == 2.0 and values[-1] == 7.0
