"""Where the time of a labelled image goes: CPU time of each stage, measured while images are made and written."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

from cad.spatial import Intrinsics
from scenes.annotations import Labeller
from scenes.bop import ShardWriter
from scenes.camera import CAMERA
from scenes.dataset_config import DatasetConfig
from scenes.dataset_folder import opened
from scenes.domains import make_renderer
from scenes.gl import mujoco
from scenes.render import ALL, Renderer, Rendering, What
from scenes.shots import ShotSampler
from scenes.stage import Stage
from scenes.workers import Shard, ShardMaker

STAGES = (
    "shot",
    "arrange",
    "dress",
    "draw colours",
    "draw ids, depth",
    "labels",
    "draw hidden parts",
    "sensor",
    "encode",
    "write",
    "checksums",
    "rest",
)
_PATCHED: tuple[tuple[Any, str, str], ...] = (
    *((ShotSampler, name, "shot") for name in ("crop", "window", "frame")),
    (Stage, "arrange", "arrange"),
    (Stage, "dress", "dress"),
    (Labeller, "label", "labels"),
    (ShardWriter, "add", "labels"),
    (ShardWriter, "finish", "labels"),
    (Path, "write_bytes", "write"),
)
_PATCHED_NAMES = {
    "scenes.image_maker.draw_look": "dress",
    "scenes.image_maker.draw_sensor": "sensor",
    "scenes.image_maker.brightest": "sensor",
    "scenes.image_maker.expose": "sensor",
    "scenes.bop.encode_png": "encode",
    "scenes.shards.write_sums": "checksums",
}


class Stopwatch:
    """CPU seconds of nested stages; each counts without those inside it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        self._open: list[str] = []
        self._last = time.process_time()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what happens inside as ``name``."""
        self.settle()
        self._open.append(name)
        try:
            yield
        finally:
            self.settle()
            self._open.pop()

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, counted as ``name``."""

        def call(*args: Any, **kwargs: Any) -> Any:
            with self.stage(name):
                return function(*args, **kwargs)

        return call

    def reset(self) -> None:
        """Forget what was counted."""
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self._last = time.process_time()

    def settle(self) -> None:
        """Count what has happened until now."""
        now = time.process_time()
        self.seconds[self._open[-1] if self._open else "rest"] += now - self._last
        self._last = now


class TimedRenderer:
    """A renderer that draws colours and labels one after the other, to tell them apart."""

    def __init__(self, renderer: Renderer, watch: Stopwatch) -> None:
        self._renderer, self._watch = renderer, watch

    def render(
        self,
        data: mujoco.MjData,
        intrinsics: Intrinsics,
        what: tuple[What, ...] = ALL,
        camera: str = CAMERA,
    ) -> Rendering:
        """See :class:`Renderer`."""
        labels: tuple[What, ...] = tuple(one for one in what if one != "rgb")
        colours = drawn = Rendering()
        if "rgb" in what:
            with self._watch.stage("draw colours"):
                colours = self._renderer.render(data, intrinsics, ("rgb",), camera)
        if labels:
            with self._watch.stage("draw ids, depth" if "depth" in labels else "draw hidden parts"):
                drawn = self._renderer.render(data, intrinsics, labels, camera)
        return Rendering(rgb=colours.rgb, instances=drawn.instances, depth_m=drawn.depth_m)

    def close(self) -> None:
        """See :class:`Renderer`."""
        self._renderer.close()


def measure_stages(config: DatasetConfig, out: Path, images: int) -> dict[str, float]:
    """Milliseconds of CPU time an image, by stage; ``images`` are made in the empty folder ``out``."""
    watch = Stopwatch()

    def timed_renderer(*args: Any, **kwargs: Any) -> TimedRenderer:
        return TimedRenderer(make_renderer(*args, **kwargs), watch)

    with ExitStack() as stack:
        split = stack.enter_context(opened(config, out))
        stack.enter_context(patch("scenes.stage.make_renderer", timed_renderer))
        for owner, attribute, name in _PATCHED:
            stack.enter_context(patch.object(owner, attribute, watch.timed(name, getattr(owner, attribute))))
        for target, name in _PATCHED_NAMES.items():
            module, attribute = target.rsplit(".", 1)
            function = getattr(import_module(module), attribute)
            stack.enter_context(patch(target, watch.timed(name, function)))
        maker = ShardMaker(config, split)
        stack.callback(maker.close)
        maker.make(Shard(index=0, first=0, count=1), lambda: None)
        watch.reset()
        maker.make(Shard(index=1, first=1, count=images), lambda: None)
        watch.settle()
    return {name: 1e3 * seconds / images for name, seconds in watch.seconds.items()}
