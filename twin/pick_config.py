"""Configuration of ``tagcell pick``."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cad.parts import BUILT_IN, part_names
from twin.views import LookKind


@dataclass(frozen=True, kw_only=True)
class PickConfig:
    """What to drop, who looks, and where the results go."""

    scenes: int = 5
    """Scenes, each with fresh parts and a fresh camera placement."""
    parts_per_class: int = 2
    """Parts of each class in a scene."""
    parts: tuple[str, ...] = BUILT_IN
    """Part classes to drop."""
    parts_dir: Path | None = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    arm_calibration: Path | None = None
    """Factory calibration of one arm (calibration.conf or ROS's YAML); the nominal arm when left out."""
    seed: int = 0
    """Seed of the scenes; the same seed gives the same scorecard."""
    estimator: Literal["learned", "oracle"] = "learned"
    """Who says where the parts are: the trained networks, or ground truth."""
    second_looks: tuple[LookKind, ...] = ("exposure", "park", "nudge")
    """Other looks at what the estimator is unsure of, before it is declined; without a value: none."""
    exposure: float = 1.0
    """The camera's usual exposure time against a good one: above 1 what shines is too bright to be read."""
    weights: Path | None = None
    """Folder of trained weights; the ones that come with Tagcell when left out."""
    out: Path = Path("runs/pick")
    """Folder for scorecard.json and the annotated frames."""
    pictures: bool = True
    """Save an annotated picture of every frame."""
    jobs: int = os.cpu_count() or 1
    """Scenes run side by side."""

    def __post_init__(self) -> None:
        for name, most in (("scenes", 100_000), ("parts_per_class", 4), ("jobs", 256)):
            value = getattr(self, name)
            if not 1 <= value <= most:
                raise ValueError(f"{name.replace('_', '-')} is {value}; it must be between 1 and {most}")
        if not (math.isfinite(self.exposure) and self.exposure > 0):
            raise ValueError(f"exposure is {self.exposure}; it must be positive")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; it must not be negative")
        known = part_names(self.parts_dir)
        unknown = [p for p in self.parts if p not in known]
        if unknown or not self.parts:
            raise ValueError(
                f"unknown part {', '.join(unknown) or '(none given)'}; parts there are: {', '.join(known)}"
            )
        if len(set(self.second_looks)) != len(self.second_looks):
            raise ValueError(f"second-looks are {', '.join(self.second_looks)}; name each kind once")
        if len(set(self.parts)) != len(self.parts):
            raise ValueError(f"parts are {', '.join(self.parts)}; name each class once and use parts-per-class")
