"""``tagcell evaluate``: how good perception is, on whole frames that it has never seen."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, UseAppendAction, arg

from twin.evaluation_config import EvaluationConfig, Method, Split
from twin.render_cli import PARTS_HINT, Domain, Faces


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure perception on whole test frames: rendered for it, or a data set.

    Writes tables, plots, pictures of failures, and results in BOP and COCO form.

    Stop it whenever you like: the same command goes on from what is finished.
    """

    domain: Annotated[Domain | None, arg(metavar="{classic,filament,mitsuba}", help_behavior_hint="")] = None
    """What draws the frames."""
    count: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 75, mitsuba 16)")] = None
    """Number of frames; of a data set, only its first N."""
    instances: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Instead of --count: go on until each part has been seen N times."""
    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 0)")] = None
    """Seed of the frames."""
    faces: Annotated[Faces | None, arg(metavar="{physics,uniform}", help_behavior_hint="(default: physics)")] = None
    """Parts rest on their faces as often as physics leaves them there, or equally often on each."""
    data: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Evaluate on this data set of whole frames instead of rendering one."""
    split: Split = "test"
    """Split that --data must be of. Figures of val are for development: choices were made on it."""
    weights: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder of trained weights; the ones that come with Tagcell when left out."""
    part: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME", help_behavior_hint=PARTS_HINT)] = ()
    """A part to show; may be given several times."""
    parts_dir: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    methods: tuple[Method, ...] = ("tagcell", "pvnet")
    """What is compared: Tagcell's own estimator; PVNet's stages, which make two rows, raw and refined."""
    detections: Annotated[tuple[Path, ...], arg(metavar="FILE...", help_behavior_hint="")] = ()
    """Detections that other programs, such as Mask R-CNN, made of the same frames, for the table of instances."""
    jobs: int = os.cpu_count() or 1
    """Processes that render, 2.5 GB each."""
    out: Path = Path("runs/evaluate")
    """Folder for the results; frames go to OUT/frames."""
    json: FlagCreatePairsOff[bool] = False
    """Print evaluation.json instead of the tables."""

    def run(self) -> None:
        """Render, evaluate, and print the result."""
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(EvaluationConfig)}
        config = EvaluationConfig(**{name: value for name, value in given.items() if value is not None})
        from twin.evaluation import run_evaluation

        report = run_evaluation(config)
        if self.json:
            print(json.dumps(report, indent=1))
        else:
            text = (self.out / "evaluation.md").read_text(encoding="utf-8")
            print(text.split("\n## Table 1")[0].rstrip())
            print(f"\nall tables: {self.out / 'evaluation.md'}")
