"""``tagcell part``: list, show, add and remove parts, and compute their stable poses."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console
from rich.progress import Progress
from tyro.conf import OmitSubcommandPrefixes, Positional, subcommand

from cad.parts import load_part, part_names

Unit = Literal["mm", "cm", "m", "um", "in", "ft"]


@contextmanager
def progress_bar(name: str) -> Iterator[Callable[[float], None]]:
    """A bar on standard error; yields what is to be told the share (0 to 1) that is done."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(name, total=1.0)
        yield lambda share: progress.update(task, completed=share)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PartList:
    """The parts there are."""

    parts_dir: Path | None = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    json: bool = False
    """Print as JSON."""

    def run(self) -> None:
        """Print one line a part."""
        from twin.part_report import print_parts

        print_parts([load_part(name, self.parts_dir) for name in part_names(self.parts_dir)], as_json=self.json)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PartShow:
    """One part: size, mass, symmetries, collision shapes, stable poses and grasps."""

    name: Positional[str]
    """Name of the part."""
    parts_dir: Path | None = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    json: bool = False
    """Print as JSON."""

    def run(self) -> None:
        """Print the part."""
        from twin.part_report import print_part

        print_part(load_part(self.name, self.parts_dir), as_json=self.json)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PartAdd:
    """Make a part of a STEP, STL, OBJ, PLY or OFF file: everything that picking it needs, in its folder."""

    file: Positional[Path]
    """The part's CAD or mesh file."""
    name: str
    """What to call it: letters, digits and underscores."""
    material: str = "steel"
    """What it is made of, for its density and its look: steel, black-steel, brass, copper, aluminium, zinc, nylon, abs,
    pom, lcp, ptfe, rubber or ceramic."""
    mass_g: float | None = None
    """Its mass in grams, where it was weighed."""
    density: float | None = None
    """Its density in kg/m3, where it differs from the material's."""
    unit: Unit | None = None
    """What the file's numbers are in; STEP files say it, meshes are taken for mm."""
    accept_size: bool = False
    """Take the part in at its size though it is unlikely for this cell."""
    replace: bool = False
    """Replace the part of that name."""
    drops: int = 2000
    """Drops in physics that the probabilities of the stable poses come from."""
    seed: int = 0
    """Seed of the drops."""
    parts_dir: Path | None = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    json: bool = False
    """Print the part as JSON."""

    def run(self) -> None:
        """Add the part and print what it is."""
        from twin.new_part import NewPartConfig, add_part
        from twin.part_report import describe_part, print_part

        fields = [f.name for f in dataclasses.fields(NewPartConfig)]
        config = NewPartConfig(**{name: getattr(self, name) for name in fields})
        console = Console(stderr=True)
        with console.status("") as status:

            def report(stage: str) -> None:
                status.update(stage)
                if not console.is_terminal:
                    console.print(stage, highlight=False)

            try:
                added = add_part(config, report)
            except KeyboardInterrupt:
                raise KeyboardInterrupt("no part was added") from None
        if self.json:
            taken = {"notes": added.intake.notes, "seconds": added.seconds}
            print(json.dumps(describe_part(added.part) | taken, indent=1))
            return
        for note in added.intake.notes:
            console.print(f"note: {note}", highlight=False)
        print_part(added.part, as_json=False)
        for stage, seconds in added.seconds.items():
            console.print(f"{seconds:6.1f} s  {stage}", highlight=False)
        total = sum(added.seconds.values())
        console.print(
            f"{total:6.1f} s  in all; try: tagcell pick --parts {self.name} --estimator oracle", highlight=False
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PartStablePoses:
    """How a part comes to rest: its stable poses with probabilities from drops, as a table and a plot."""

    name: Positional[str]
    """Name of the part."""
    drops: int = 2000
    """Drops in physics."""
    seed: int = 0
    """Seed of the drops."""
    out: Path = Path("runs/stable_poses")
    """Folder for NAME.png, the plot, and NAME.json, with every settled drop."""
    write: bool = False
    """Keep the poses in the part's folder, and plan its grasps anew."""
    parts_dir: Path | None = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    json: bool = False
    """Print as JSON, without the drops."""

    def run(self) -> None:
        """Drop the part and print, plot and save what came of it."""
        from scenes.stable_poses import StablePoseConfig
        from twin.grasps import write_grasps
        from twin.scorecard import check_writable, write_json
        from twin.stable_pose_plot import plot_stable_poses
        from twin.stable_pose_report import print_stable_poses, stable_pose_report

        part = load_part(self.name, self.parts_dir)
        config = StablePoseConfig(drops=self.drops, seed=self.seed)
        check_writable(self.out)
        with progress_bar(f"dropping {self.name}") as advance:
            report = stable_pose_report(part, config, advance)
        document, plot = report.as_json(), self.out / f"{self.name}.png"
        write_json(self.out / f"{self.name}.json", document)
        plot_stable_poses(report, plot)
        if self.write:
            report.write()
            write_grasps(load_part(self.name, self.parts_dir))
        if self.json:
            print(json.dumps({k: v for k, v in document.items() if k != "settled"} | {"plot": str(plot)}, indent=1))
        else:
            print_stable_poses(report)
            print(plot)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PartRemove:
    """Remove one of your own parts."""

    name: Positional[str]
    """Name of the part."""
    parts_dir: Path | None = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    json: bool = False
    """Print as JSON."""

    def run(self) -> None:
        """Remove the part's folder."""
        from twin.new_part import remove_part

        gone = remove_part(self.name, self.parts_dir)
        print(json.dumps({"removed": str(gone)}) if self.json else f"removed {gone}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """Parts: list, show, add and remove them, compute how they come to rest."""

    action: OmitSubcommandPrefixes[
        Annotated[PartList, subcommand("list")]
        | Annotated[PartShow, subcommand("show", prefix_name=False)]
        | Annotated[PartAdd, subcommand("add", prefix_name=False)]
        | Annotated[PartStablePoses, subcommand("stable-poses", prefix_name=False)]
        | Annotated[PartRemove, subcommand("remove", prefix_name=False)]
    ]

    def run(self) -> None:
        """Run the chosen action."""
        self.action.run()
