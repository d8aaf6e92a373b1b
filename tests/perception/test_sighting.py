import numpy as np
import pytest

from cad.spatial import BASLER
from perception.segmentation import Detection
from perception.sighting import sighting_of


def detection(u: int, v: int, side: int = 20) -> Detection:
    """A square mask of ``side`` pixels of the frame reduced by 4, from (u, v) on."""
    return Detection(
        centre_px=np.array([4.0 * u, 4.0 * v]),
        score=0.8,
        class_probabilities=np.array([0.3, 0.7]),
        mask=np.ones((side, side), bool),
        mask_origin=(u, v),
    )


def test_the_mask_lies_where_the_crop_shows_it() -> None:
    crop = BASLER.crop(2000, 1000, 256, 256).downscaled(2)
    seen = sighting_of(detection(510, 260), ("a", "b"), BASLER, crop)
    expected = np.zeros((128, 128), bool)
    expected[20:60, 20:60] = True  # frame pixels 2040 to 2119 and 1040 to 1119
    assert seen.overlap(expected) == 1.0
    assert seen.class_probabilities == {"a": pytest.approx(0.3), "b": pytest.approx(0.7)}
    assert not seen.cut
    half = expected.copy()
    half[:, :40] = False
    assert seen.overlap(half) == pytest.approx(0.5)
    assert seen.overlap(np.zeros((128, 128), bool)) == 0.0


def test_masks_at_the_border_are_cut() -> None:
    crop = BASLER.crop(0, 0, 256, 256).downscaled(2)
    seen = sighting_of(detection(0, 30), ("a", "b"), BASLER, crop)
    assert seen.cut
    assert seen.mask[60:100, :40].all()
    assert seen.mask.sum() == 40 * 40
    last = sighting_of(detection(BASLER.width // 4 - 20, 30), ("a", "b"), BASLER, crop)
    assert last.cut
    assert not last.mask.any()
