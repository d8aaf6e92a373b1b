"""What a data set holds: one frozen config that decides every byte of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from cad.parts import BUILT_IN, Part, load_part
from cad.spatial import BASLER, Intrinsics
from scenes.bop import DEPTH_REACH_M
from scenes.domains import DOMAINS, Domain
from scenes.errors import SceneError
from scenes.ranges import LOOKS, VIEWS, LensRanges, LookRanges, SensorRanges, Split, ViewRanges
from scenes.rests import Faces
from scenes.shots import SHOTS, ShotRanges

Kind = Literal["crop", "window", "scene"]

SIZES: dict[Kind, tuple[int, int]] = {"crop": (256, 256), "window": (320, 320), "scene": (2208, 1242)}
DOWNSCALES: dict[Kind, int] = {"crop": 1, "window": 4}
SHARDS: dict[Domain, dict[Kind, int]] = {
    "classic": {"crop": 500, "window": 250, "scene": 25},
    "filament": {"crop": 250, "window": 100, "scene": 20},
    "mitsuba": {"crop": 25, "window": 25, "scene": 5},
}
"""Images a shard: about ten seconds of work, so that little is lost when a run is stopped."""
MAX_SHARD = 1000
FACTORS = tuple(n for n in range(1, 65) if BASLER.width % n == 0 and BASLER.height % n == 0)
"""How much smaller than the camera's frame crops and windows may be: by factors that leave whole pixels."""


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """What to generate. All of it decides the images: the same config gives the same bytes, by any number of workers.

    ``kind``: ``crop``, a window of the camera's frame round one part; ``window``, one with any number of parts;
    ``scene``, a whole frame. ``size`` (width, height) in pixels. A crop or window is ``downscale`` times smaller than
    that piece of the camera's frame; a frame is the sensor scaled, with what is too much in one direction cut off.
    ``count`` images are made, or as many as hold ``instances`` of each part. ``faces``: parts rest on faces as often as
    ``physics`` leaves them there, or ``uniform``. ``jpeg``: quality of the colour files, None for PNG. ``shard``:
    images a folder.
    """

    kind: Kind = "crop"
    domain: Domain = "classic"
    split: Split = "train"
    count: int | None = 1000
    instances: int | None = None
    seed: int = 0
    size: tuple[int, int] | None = None
    downscale: int | None = None
    shard: int | None = None
    faces: Faces = "physics"
    depth: bool = True
    jpeg: int | None = None
    parts: tuple[str, ...] = ()
    parts_dir: Path | None = None
    look: LookRanges | None = None
    shots: ShotRanges | None = None
    view: ViewRanges | None = None
    sensor: SensorRanges = field(default_factory=SensorRanges)
    lens: LensRanges = field(default_factory=LensRanges)

    def __post_init__(self) -> None:
        _check_choice("kind", self.kind, get_args(Kind))
        _check_choice("domain", self.domain, DOMAINS)
        _check_choice("split", self.split, get_args(Split))
        _check_choice("faces", self.faces, get_args(Faces))
        if (self.count is None) == (self.instances is None):
            raise SceneError(f"count {self.count} and instances {self.instances}: give one of them, None for the other")
        for name in ("count", "instances", "downscale"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise SceneError(f"{name} {value}: must be at least 1")
        if self.seed < 0:
            raise SceneError(f"seed {self.seed}: must not be negative")
        if self.shard is not None and not 1 <= self.shard <= MAX_SHARD:
            raise SceneError(f"shard {self.shard}: must be 1 to {MAX_SHARD} images, as many as BOP allows a folder")
        if self.jpeg is not None and not 1 <= self.jpeg <= 100:
            raise SceneError(f"jpeg {self.jpeg}: a quality from 1 to 100, or None for PNG")
        highest = self.view_ranges.height_m[1]
        if self.depth and highest >= DEPTH_REACH_M:
            raise SceneError(f"height_m up to {highest}: depth images reach {DEPTH_REACH_M} m; set depth to False")
        if self.kind == "scene" and self.downscale is not None:
            raise SceneError(f"downscale {self.downscale}: a scene is scaled to its size; leave downscale out")
        if len(set(self.names)) < len(self.names):
            raise SceneError(f"parts {', '.join(self.names)}: name each part once")
        smaller = 1 if self.kind == "scene" else int(self.scale_down)
        if smaller not in FACTORS:
            raise SceneError(
                f"downscale {smaller}: must divide the camera's frame: one of {', '.join(map(str, FACTORS))}"
            )
        width, height = self.pixels
        most = (BASLER.width // smaller, BASLER.height // smaller)
        if not (32 <= width <= most[0] and 32 <= height <= most[1]):
            raise SceneError(f"size {width} x {height}: must be from 32 x 32 to {most[0]} x {most[1]} pixels")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts shown: those asked for, or the built-in ones."""
        return self.parts or BUILT_IN

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height of an image."""
        return self.size or SIZES[self.kind]

    @property
    def scale_down(self) -> float:
        """How much smaller than the camera's own a pixel of the image is drawn."""
        if self.kind != "scene":
            return self.downscale or DOWNSCALES[self.kind]
        width, height = self.pixels
        return min(BASLER.width / width, BASLER.height / height)

    @property
    def frame(self) -> Intrinsics:
        """The frame that images are windows of: the camera's, scaled; for a scene the image itself."""
        if self.kind != "scene":
            return BASLER.downscaled(int(self.scale_down))
        width, height = self.pixels
        scale = 1 / self.scale_down
        f = BASLER.fx * scale
        return Intrinsics(
            width=width,
            height=height,
            fx=f,
            fy=f,
            cx=(BASLER.cx + 0.5) * scale - 0.5 - (BASLER.width * scale - width) / 2,
            cy=(BASLER.cy + 0.5) * scale - 0.5 - (BASLER.height * scale - height) / 2,
        )

    @property
    def look_ranges(self) -> LookRanges:
        """What light, materials and board vary in: what was asked for, or the split's own."""
        return self.look or LOOKS[self.split]

    @property
    def shot_ranges(self) -> ShotRanges:
        """What lies where: what was asked for, or the split's own."""
        return self.shots or SHOTS[self.split]

    @property
    def view_ranges(self) -> ViewRanges:
        """Where the camera is: what was asked for, or the split's own."""
        return self.view or VIEWS[self.split]

    @property
    def shard_size(self) -> int:
        """Images a shard."""
        return self.shard or SHARDS[self.domain][self.kind]

    def load_parts(self) -> list[Part]:
        """The parts shown, in order; raises SceneError for parts that labels could not tell apart."""
        parts = [load_part(name, self.parts_dir) for name in self.names]
        numbers = [part.obj_id for part in parts]
        if len(set(numbers)) < len(numbers):
            told = ", ".join(f"{part.name} {part.obj_id}" for part in parts)
            raise SceneError(f"parts of one set need different obj_ids, not {told}; add one of them again")
        return parts


def _check_choice(name: str, value: str, valid: tuple[str, ...]) -> None:
    if value not in valid:
        raise SceneError(f"{name} {value!r} is not one of {', '.join(valid)}")
