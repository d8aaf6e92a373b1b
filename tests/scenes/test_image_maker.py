"""The stage of a data set fits its images: light and shadows reach as far as they show."""

import numpy as np
import pytest

from scenes.dataset_config import DatasetConfig
from scenes.image_maker import SHADOWS, ImageMaker, half_diagonal_m, stage_config
from scenes.ranges import LookRanges, SensorRanges, ViewRanges
from scenes.stage import CONE


def at(height_m):
    return ViewRanges(height_m=(height_m, height_m))


@pytest.mark.parametrize("split", ["train", "val", "test"])
@pytest.mark.parametrize(
    ("kind", "settings", "pixels"),
    [
        ("crop", {}, 1024),
        ("crop", {"size": (128, 128), "downscale": 2}, 512),
        ("window", {}, 1024),
        ("scene", {}, 4096),
    ],
)
def test_usual_sizes_have_the_usual_shadows(kind, settings, pixels, split):
    stage = stage_config(DatasetConfig(kind=kind, split=split, **settings))
    assert (stage.shadow_half_m, stage.shadow_size) == (SHADOWS[kind][0], pixels)


@pytest.mark.parametrize(
    "config",
    [
        DatasetConfig(kind="crop", size=(1000, 600)),
        DatasetConfig(kind="crop", size=(1600, 1600)),
        DatasetConfig(kind="crop", size=(300, 300), downscale=4),
        DatasetConfig(kind="window", size=(640, 480)),
        DatasetConfig(kind="window", view=at(1.3)),
    ],
)
def test_larger_windows_are_shadowed_to_their_corners_as_finely(config):
    stage, (half_m, pixels) = stage_config(config), SHADOWS[config.kind]
    assert stage.shadow_half_m >= half_diagonal_m(config) > half_m
    coarser = 2 if config.kind == "crop" and config.scale_down > 1 else 1
    assert stage.shadow_half_m / stage.shadow_size == pytest.approx(coarser * half_m / pixels)


@pytest.mark.parametrize("kind", ["crop", "window", "scene"])
@pytest.mark.parametrize("height_m", [0.3, 0.7, 1.0, 1.3])
def test_light_reaches_the_corners_of_the_largest_images(kind, height_m):
    size = (5472, 3648) if kind == "scene" else (1368, 912)
    config = DatasetConfig(kind=kind, size=size, downscale=None if kind == "scene" else 4, view=at(height_m))
    assert CONE * stage_config(config).shadow_half_m > 1.05 * half_diagonal_m(config)


@pytest.mark.parametrize("domain", ["classic", "filament"])
def test_a_large_crop_is_lit_to_its_corners(domain, tmp_path):
    config = DatasetConfig(
        kind="crop",
        domain=domain,
        size=(400, 400),
        downscale=4,
        look=LookRanges(default_look=1.0),
        sensor=SensorRanges(gradient=0.0, blur_px=(1.0, 1.0)),
    )
    maker = ImageMaker(config, tmp_path)
    try:
        image = maker.make(1).image.astype(float)
    finally:
        maker.close()
    middle, top = np.median(image[150:250, 150:250]), np.median(image[:15, :15])
    assert top > 0.85 * middle
