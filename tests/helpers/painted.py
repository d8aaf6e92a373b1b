"""A maker of small images that takes no renderer: what is in image ``i`` follows from config and ``i``."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from cad.spatial import BASLER, transform
from scenes.bop import Annotation
from scenes.image_maker import LabelledImage
from scenes.lens import STRAIGHT


class PaintedMaker:
    """Stands in for :class:`scenes.image_maker.ImageMaker`; ``made`` lists the images asked of any of them."""

    made: ClassVar[list[int]] = []
    absent: ClassVar[tuple[str, ...]] = ()

    def __init__(self, config, folder=None):
        self._config = config
        self._parts = [part for part in config.load_parts() if part.name not in self.absent]

    def make(self, index):
        """Image ``index``: one part, two or three in turn; in every sixth image only a twentieth of them is seen."""
        self.made.append(index)
        config = self._config
        rng = np.random.default_rng([config.seed, index])
        width, height = config.pixels
        annotations = []
        for part in self._parts[: 1 + index % 3]:
            silhouette = np.ones((20, 20), bool)
            visible = silhouette.copy()
            if index % 6 == 2:
                visible[1:] = False
            annotations.append(
                Annotation(
                    obj_id=part.obj_id,
                    stable_pose=0,
                    T_cam_part=transform(np.eye(3), [0, 0, 0.7]),
                    corner=(2, 3),
                    silhouette=silhouette,
                    visible=visible,
                    keypoints=np.zeros((8, 3)),
                )
            )
        return LabelledImage(
            image=rng.integers(0, 256, (height, width, 3), np.uint8),
            intrinsics=BASLER.crop(0, 0, width, height),
            lens=STRAIGHT,
            gamma=1.0,
            T_cam_board=transform(np.eye(3), [0, 0, 0.7]),
            annotations=annotations,
            depth_m=np.full((height, width), 0.7, np.float32) if config.depth else None,
        )

    def close(self):
        """Nothing to free."""
