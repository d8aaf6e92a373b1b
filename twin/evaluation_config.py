"""Configuration of ``tagcell evaluate``: what is evaluated on what."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from twin.render_cli import Domain, Faces
from twin.robot import TwinError

if TYPE_CHECKING:
    from scenes.dataset_config import DatasetConfig

DOMAINS = get_args(Domain)
Split = Literal["test", "val"]
Method = Literal["tagcell", "pvnet"]


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """What is evaluated on what. Either a ``domain`` of which frames are rendered, or a finished data set, ``data``.

    ``count`` frames, or as many as show each part ``instances`` times; of a data set the first ``count``. Raises
    TwinError for settings that contradict one another or make no sense.
    """

    out: Path
    domain: str | None = None
    count: int | None = None
    instances: int | None = None
    seed: int | None = None
    faces: Faces | None = None
    data: Path | None = None
    split: Split = "test"
    weights: Path | None = None
    part: tuple[str, ...] = ()
    parts_dir: Path | None = None
    methods: tuple[Method, ...] = ("tagcell", "pvnet")
    detections: tuple[Path, ...] = ()
    jobs: int = os.cpu_count() or 1

    def __post_init__(self) -> None:
        self._check_values()
        if self.data is None:
            if self.domain is None:
                raise TwinError(f"give --domain, one of {', '.join(DOMAINS)}, or a data set with --data")
            if self.split != "test":
                raise TwinError(f"--split {self.split} goes with --data only: frames are rendered of split test")
        else:
            for name in ("instances", "seed", "faces", "part"):
                if value := getattr(self, name):
                    said = " ".join(value) if name == "part" else value
                    raise TwinError(f"--{name} {said} and --data {self.data}: the data set is as it was rendered")
        if self.count is not None and self.instances is not None:
            raise TwinError(f"--count {self.count} and --instances {self.instances}: give one of them")

    def _check_values(self) -> None:
        for name, least in (("count", 1), ("instances", 1), ("seed", 0), ("jobs", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise TwinError(f"{name} {value}: must be at least {least}")
        if self.domain is not None and self.domain not in DOMAINS:
            raise TwinError(f"domain {self.domain!r} is not one of {', '.join(DOMAINS)}")
        known = get_args(Method)
        unknown = [m for m in self.methods if m not in known]
        if unknown or not self.methods:
            raise TwinError(f"methods {', '.join(unknown) or '(none)'}: choose from {', '.join(known)}")

    @property
    def frames(self) -> Path:
        """The data set: the one that was given, or where it is rendered."""
        return self.data or self.out / "frames"

    def dataset(self) -> DatasetConfig:
        """The frames to render: those of the domain's recipe, with what was asked for otherwise."""
        from scenes.recipes import load_recipe

        config = load_recipe(f"eval_frames_{self.domain}{'_uniform' if self.faces == 'uniform' else ''}")
        seed = config.seed + 1000 * (self.seed or 0)
        config = replace(config, seed=seed, parts=self.part, parts_dir=self.parts_dir)
        if self.instances is not None:
            return replace(config, count=None, instances=self.instances)
        return replace(config, count=self.count or config.count)
