"""One labelled image from its number: draw a shot, arrange and dress the stage, render, expose, label."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array, Intrinsics, inverse
from scenes.annotations import Labeller
from scenes.bop import Annotation
from scenes.dataset_config import DatasetConfig, Split
from scenes.distractors import distractor_meshes
from scenes.randomize import draw_look, draw_sensor
from scenes.sensor import expose
from scenes.shots import Shot, ShotSampler
from scenes.stage import Stage, StageConfig
from scenes.textures import make_textures

TEXTURES = 36
STREAMS: dict[Split, int] = {"train": 101, "val": 202, "test": 303}
"""First word of every seed of a split: no two splits share a shot, a background or an environment."""
FULL_MARGIN_PX = 160
"""A part that reaches the border of a full-size crop may go on by at most its diameter: 10 mm are 150 px."""


@dataclass(frozen=True, kw_only=True)
class LabelledImage:
    """An image (H, W, 3) uint8 with its camera, its parts and, where asked for, the distance seen in each pixel."""

    image: NDArray[np.uint8]
    intrinsics: Intrinsics
    T_cam_board: Array
    annotations: list[Annotation]
    depth_m: NDArray[np.float32] | None


class ImageMaker:
    """Makes the images of one data set in any order; holds the compiled stage. Close it when done.

    Image ``index`` depends on the config and on ``index`` only. Its shot, its look and its sensor have streams of
    their own, so what is seen where is the same in every domain.
    """

    def __init__(self, config: DatasetConfig) -> None:
        self._config = config
        parts = config.load_parts()
        textures = make_textures(np.random.default_rng(STREAMS[config.split]), TEXTURES)
        self._stage = Stage(parts, textures, stage_config(config), domain=config.domain)
        self._labeller = Labeller(self._stage)
        radii = {n: float(np.linalg.norm(m.vertices[:, :2], axis=1).max()) for n, m in distractor_meshes().items()}
        self._sampler = ShotSampler(parts, radii, config.shots)

    def make(self, index: int) -> LabelledImage:
        """Image number ``index``."""
        config, stage = self._config, self._stage
        seeds = np.random.SeedSequence([STREAMS[config.split], config.seed, index]).spawn(3)
        shot_rng, look_rng, sensor_rng = (np.random.default_rng(seed) for seed in seeds)
        shot = self._shot(shot_rng)
        instances = stage.arrange(shot)
        look = draw_look(config.look, TEXTURES, look_rng)
        stage.dress(shot, look, config.look, look_rng)
        drawn = stage.render(shot.intrinsics, ("rgb", "instances", "depth"))
        assert drawn.rgb is not None and drawn.instances is not None
        brightest = float(np.percentile(drawn.rgb[::4, ::4], 98))
        sensor = draw_sensor(config.look, brightest, sensor_rng)
        return LabelledImage(
            image=expose(drawn.rgb, sensor, sensor_rng, shot.downscale),
            intrinsics=shot.intrinsics,
            T_cam_board=inverse(shot.T_board_cam),
            annotations=self._labeller.label(shot, instances, drawn),
            depth_m=drawn.depth_m if config.depth else None,
        )

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


def stage_config(config: DatasetConfig) -> StageConfig:
    """Slots, window size and shadow map for the images of a data set."""
    width, height = config.pixels
    margin = 2 * int(np.ceil(FULL_MARGIN_PX / config.scale_down))
    size = (width + margin, height + margin)
    if config.kind == "scene":
        return StageConfig(slots=16, max_size=size, shadow_half_m=0.2, shadow_size=4096)
    if config.kind == "window":
        return StageConfig(slots=8, max_size=size, shadow_half_m=0.07, shadow_size=1024)
    return StageConfig(slots=4, max_size=size, shadow_half_m=0.025, shadow_size=512 if config.scale_down > 1 else 1024)
