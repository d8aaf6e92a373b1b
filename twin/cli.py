"""The ``tagcell`` command: one frozen dataclass a verb, parsed by tyro.

Heavy packages are imported by the verb that needs them, so that help and errors are quick.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from cad.parts import CadError
from perception.estimates import PerceptionError
from scenes.errors import SceneError
from twin.estimate_cli import Estimate
from twin.evaluate_cli import Evaluate
from twin.export_cli import Export
from twin.part_cli import Part
from twin.pick_config import PickConfig
from twin.render_cli import Data, Render
from twin.robot import TwinError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pick(PickConfig):
    """Drop parts onto the board, perceive, pick and place them, and score every pick against physics.

    Writes OUT/scorecard.json and OUT/frames/*.jpg.
    """

    json: bool = False
    """Print the scorecard as JSON instead of the table."""

    def run(self) -> None:
        """Run the scenes and print the result."""
        from twin.pick import run_pick
        from twin.report import print_scorecard

        fields = [f.name for f in dataclasses.fields(PickConfig)]
        card = run_pick(PickConfig(**{name: getattr(self, name) for name in fields}), quiet=self.json)
        if self.json:
            print(json.dumps(card, indent=1))
        else:
            print_scorecard(card, self.out)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train:
    """Render the training data where it is missing and train all networks; resumes where it was stopped."""

    part: tuple[str, ...] = ()
    """Parts to learn; the built-in ones by default. Others were added with `tagcell part add`."""
    parts_dir: Path | None = None
    """Folder with a user's own parts; TAGCELL_PARTS_DIR by default."""
    data: Path = Path("data")
    """Folder for the rendered data."""
    out: Path = Path("runs/train")
    """Folder for weights, checkpoints, curves and pictures; use OUT/weights with `tagcell pick --weights`."""
    minutes: float = 60.0
    """How long the networks learn; rendering and fitting the choice come on top. Less than 60 renders less data."""
    seed: int = 0
    """Seed of the data and of the training."""
    threads: int = os.cpu_count() or 1
    """Threads of the processor to use."""
    json: bool = False
    """Print the paths of the weights as JSON."""

    def run(self) -> None:
        """Train everything."""
        from twin.training import TrainPlan, train_all

        written = train_all(
            TrainPlan(
                data=self.data,
                out=self.out,
                minutes=self.minutes,
                seed=self.seed,
                threads=self.threads,
                parts=self.part,
                parts_dir=self.parts_dir,
            )
        )
        print(json.dumps([str(p) for p in written]) if self.json else "\n".join(map(str, written)))


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """Save pictures of the cell: from the side, and as its camera sees it."""

    seed: int = 0
    """Seed of the parts dropped onto the board."""
    out: Path = Path("runs/view")
    """Folder for cell.jpg and camera.jpg."""
    json: bool = False
    """Print the paths as JSON."""

    def run(self) -> None:
        """Render and save."""
        from twin.view import save_views

        written = [str(p) for p in save_views(self.out, seed=self.seed)]
        print(json.dumps(written) if self.json else "\n".join(written))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Doctor:
    """Check what Tagcell needs of this machine and print what mends it."""

    fix: bool = False
    """Install what is missing, where this user may."""
    json: bool = False
    """Print as JSON."""

    def run(self) -> None:
        """Print versions and checks."""
        from twin.doctor import doctor

        report = doctor(fix=self.fix)
        if self.json:
            print(json.dumps(report, indent=1))
        else:
            print("\n".join(f"{name:24s} {value}" for name, value in report.items()))


Verb = (
    Annotated[Pick, subcommand("pick")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Data, subcommand("data")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Estimate, subcommand("estimate")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Part, subcommand("part")]
    | Annotated[View, subcommand("view")]
    | Annotated[Doctor, subcommand("doctor")]
)


def main(arguments: list[str] | None = None) -> Any:
    """Entry point: exit 0 when done, 1 with one line on stderr for a known error, 2 for wrong usage, 130 for Ctrl-C."""
    verb = tyro.cli(
        OmitArgPrefixes[OmitSubcommandPrefixes[Verb]],  # type: ignore[valid-type]
        prog="tagcell",
        description="Tagcell: a digital twin of a small-part picking cell, from CAD to scored pick and place.",
        args=arguments,
    )
    try:
        verb.run()
    except KeyboardInterrupt as stop:
        print(f"\ntagcell: stopped; {str(stop) or 'what was finished is kept'}", file=sys.stderr)
        sys.exit(130)
    except (CadError, PerceptionError, SceneError, TwinError, OSError) as error:
        print(f"tagcell: {error}", file=sys.stderr)
        sys.exit(1)
