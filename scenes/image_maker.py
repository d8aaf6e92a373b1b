"""One labelled image from its number: draw a shot, arrange and dress the stage, render, expose, label."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array, Intrinsics, inverse
from scenes.annotations import Labeller
from scenes.bop import Annotation
from scenes.dataset_config import DatasetConfig, Kind
from scenes.environments import make_environments
from scenes.lens import Lens
from scenes.randomize import draw_lens, draw_look, draw_sensor
from scenes.ranges import Split
from scenes.rests import RestPool
from scenes.sensor import brightest, expose, mosaic_phase
from scenes.shots import Shot, ShotSampler
from scenes.stage import CONE, Stage, StageConfig
from scenes.textures import make_textures, make_wear

TEXTURES, ENVIRONMENTS, WORN_TAGS = 36, 12, 3
STREAMS: dict[Split, int] = {"train": 101, "val": 202, "test": 303}
"""First word of every seed of a split: no two splits share a shot, a background or an environment."""

SHADOWS: dict[Kind, tuple[float, int]] = {"crop": (0.025, 1024), "window": (0.07, 1024), "scene": (0.2, 4096)}
"""Half the side, m, of the square that shadows are computed for, and the pixels of its map, at the usual sizes."""


@dataclass(frozen=True, kw_only=True)
class LabelledImage:
    """An image (H, W, 3) uint8 with its camera, its parts and, where asked for, the distance seen in each pixel.

    ``gamma`` is the camera's: grey levels are linear in light where it is 1.
    """

    image: NDArray[np.uint8]
    intrinsics: Intrinsics
    lens: Lens
    gamma: float
    T_cam_board: Array
    annotations: list[Annotation]
    depth_m: NDArray[np.float32] | None


class ImageMaker:
    """Makes the images of one data set in any order; holds the compiled stage. Close it when done.

    Image ``index`` depends on the config and on ``index`` only. Its shot, its look and its sensor have streams of
    their own, so what is seen where is the same in every domain. How parts rest is kept in ``folder``, for the next one
    who makes images of the same data set; without it, parts are dropped anew (a few seconds).
    """

    def __init__(self, config: DatasetConfig, folder: Path | None = None) -> None:
        self._config = config
        parts = config.load_parts()
        streams = backgrounds(config.split)
        self._stage = Stage(
            parts,
            make_textures(streams[0], TEXTURES),
            stage_config(config),
            domain=config.domain,
            environments=make_environments(streams[1], 0 if config.domain == "classic" else ENVIRONMENTS),
            wear=make_wear(streams[2], WORN_TAGS),
        )
        self._labeller = Labeller(self._stage)
        rests = RestPool.make(parts) if folder is None else RestPool.load_or_make(parts, folder)
        self._sampler = ShotSampler(rests, config.shot_ranges, config.view_ranges, config.faces)

    def make(self, index: int) -> LabelledImage:
        """Image number ``index``."""
        config, stage = self._config, self._stage
        shot_rng, look_rng, sensor_rng = image_streams(config.split, config.seed, index)
        shot = self._shot(shot_rng)
        instances = stage.arrange(shot)
        stage.lens = lens = draw_lens(config.lens, sensor_rng)
        ranges = config.look_ranges
        look = draw_look(ranges, TEXTURES, look_rng, environments=ENVIRONMENTS, worn=WORN_TAGS)
        stage.dress(shot, look, ranges, look_rng)
        drawn = stage.render(shot.intrinsics, ("rgb", "instances", "depth"))
        assert drawn.rgb is not None and drawn.instances is not None
        sensor = draw_sensor(config.sensor, brightest(drawn.rgb), sensor_rng)
        return LabelledImage(
            image=expose(drawn.rgb, sensor, sensor_rng, shot.downscale, mosaic_phase(shot.intrinsics)),
            intrinsics=shot.intrinsics,
            lens=lens,
            gamma=sensor.gamma,
            T_cam_board=inverse(shot.T_board_cam),
            annotations=self._labeller.label(shot, instances, drawn),
            depth_m=drawn.depth_m if config.depth else None,
        )

    @property
    def stage(self) -> Stage:
        """What the images are rendered from."""
        return self._stage

    def close(self) -> None:
        """Free the renderer."""
        self._stage.close()

    def _shot(self, rng: np.random.Generator) -> Shot:
        config = self._config
        if config.kind == "crop":
            return self._sampler.crop(rng, config.pixels, int(config.scale_down))
        if config.kind == "window":
            return self._sampler.window(rng, config.pixels, int(config.scale_down))
        return self._sampler.frame(rng, config.frame, config.scale_down)


def backgrounds(split: Split) -> list[np.random.Generator]:
    """The streams of a split's textures, environments and wear."""
    return [np.random.default_rng([STREAMS[split], kind]) for kind in range(3)]


def image_streams(split: Split, seed: int, index: int) -> list[np.random.Generator]:
    """The streams of an image's shot, look and sensor."""
    seeds = np.random.SeedSequence([STREAMS[split], seed, index]).spawn(3)
    return [np.random.default_rng(child) for child in seeds]


def stage_config(config: DatasetConfig) -> StageConfig:
    """Slots, window size and shadow map for the images of a data set; larger windows are lit and shadowed farther.

    Shadows reach the corners, or what scenes usually have of them, and light always does.
    """
    half_m, pixels = SHADOWS[config.kind]
    if config.kind == "crop" and config.scale_down > 1:
        pixels //= 2
    reach = half_diagonal_m(config)
    while half_m < min(reach, max(SHADOWS["scene"][0], 1.1 * reach / CONE)):
        half_m, pixels = 2 * half_m, min(2 * pixels, SHADOWS["scene"][1])
    slots = config.shot_ranges.most_parts(config.kind)
    return StageConfig(slots=slots, max_size=config.pixels, shadow_half_m=half_m, shadow_size=pixels)


def half_diagonal_m(config: DatasetConfig) -> float:
    """How far the corners of the largest images are from their middles, on the board."""
    return float(np.hypot(*config.pixels)) / 2 * config.view_ranges.height_m[1] / config.frame.fx
