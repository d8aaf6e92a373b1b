"""``tagcell render`` makes data sets; ``tagcell data`` checks one, shows what they vary in, and lists recipes."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, OmitSubcommandPrefixes, Positional, UseAppendAction, arg, subcommand

from scenes.errors import SceneError

if TYPE_CHECKING:
    from scenes.dataset_config import DatasetConfig

Kind = Literal["crop", "window", "scene"]
Domain = Literal["classic", "filament", "mitsuba"]
Split = Literal["train", "val", "test"]
Faces = Literal["physics", "uniform"]
PARTS_HINT = "(default: the built-in ones)"
SIZES_HINT = "(default: crop 256x256, window 320x320, scene 2208x1242)"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Render:
    """Render a labelled data set in BOP layout, with COCO files.

    Stop it whenever you like: the same command goes on from what is finished.

    The images depend on the settings only, not on --jobs or --ray.
    """

    recipe: Annotated[str | None, arg(metavar="NAME|FILE.json", help_behavior_hint="")] = None
    """Settings by name, see `tagcell data recipes`, or a file of your own, in which ranges can be changed, too."""
    kind: Annotated[Kind | None, arg(metavar="{crop,window,scene}", help_behavior_hint="(default: crop)")] = None
    """A window of the camera's frame round one part; one with any number of parts; or a whole frame."""
    part: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME", help_behavior_hint=PARTS_HINT)] = ()
    """A part to show; may be given several times."""
    domain: Annotated[
        Domain | None, arg(metavar="{classic,filament,mitsuba}", help_behavior_hint="(default: classic)")
    ] = None
    """What draws the images."""
    split: Annotated[Split | None, arg(metavar="{train,val,test}", help_behavior_hint="(default: train)")] = None
    """Which lights, backgrounds and camera heights to draw from."""
    count: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 1000)")] = None
    """Number of images. A data set can be made longer later."""
    instances: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Instead of --count: go on until each part has been seen N times, a tenth of it at least."""
    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 0)")] = None
    """Seed of everything that is drawn."""
    size: Annotated[str | None, arg(metavar="WxH", help_behavior_hint=SIZES_HINT)] = None
    """Width and height of an image in pixels."""
    downscale: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: crop 1, window 4)")] = None
    """How many of the camera's pixels, in each direction, make one of a crop or window."""
    faces: Annotated[Faces | None, arg(metavar="{physics,uniform}", help_behavior_hint="(default: physics)")] = None
    """Parts rest on their faces as often as physics leaves them there, or equally often on each."""
    jpeg: Annotated[int | None, arg(metavar="QUALITY", help_behavior_hint="(default: PNG)")] = None
    """Write colours as JPEG of this quality, 1 to 100."""
    no_depth: FlagCreatePairsOff[bool] = False
    """Leave the depth images out."""
    shard: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: ten seconds of work)")] = None
    """Images a folder, at most 1000."""
    parts_dir: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    jobs: int = os.cpu_count() or 1
    """Worker processes, of one core each."""
    ray: Annotated[str | None, arg(metavar="ADDRESS|local", help_behavior_hint="")] = None
    """Share the work out over the Ray cluster at this address, or over one that is started here with --jobs workers.
    --out must be a folder that all its machines share."""
    verify: FlagCreatePairsOff[bool] = False
    """First compare everything that is there with its checksums."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: data/RECIPE or data/KINDs)")] = None
    """Folder of the data set."""
    json: FlagCreatePairsOff[bool] = False
    """Print where the data set is and what it holds as JSON."""

    def run(self) -> None:
        """Generate what is missing of the data set."""
        from scenes.generate import generate
        from twin.render_progress import image_progress

        config = self.config()
        out = self.out or Path("data") / (Path(self.recipe).stem if self.recipe else f"{config.kind}s")
        usual = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # ends the workers, too
        try:
            with image_progress(out.name) as report:
                made = generate(config, out, jobs=self.jobs, ray=self.ray or "", verify=self.verify, report=report)
        finally:
            signal.signal(signal.SIGTERM, usual)
        if self.json:
            print(json.dumps({"out": str(out)} | made, indent=1))
        else:
            seen = ", ".join(f"{name} {number}" for name, number in made["instances"].items())
            print(f"{out}: {made['images']} images in {len(made['shards'])} shards; instances seen: {seen}")

    def config(self) -> DatasetConfig:
        """The config of the data set; raises SceneError for settings that make none or contradict the recipe."""
        from scenes.dataset_config import DatasetConfig
        from scenes.recipes import load_recipe

        given = self._given()
        if self.recipe is None:
            settings: dict[str, Any] = given if self.instances is None else {"count": None} | given
            return DatasetConfig(**settings)
        config = load_recipe(self.recipe)
        for name, value in given.items():
            has = getattr(config, name)
            if name != "parts_dir" and value != has:
                raise SceneError(
                    f"{_option(name, value)} contradicts recipe {self.recipe!r}, whose {name} is {has}; "
                    "leave one of them out"
                )
        return dataclasses.replace(config, parts_dir=self.parts_dir)

    def _given(self) -> dict[str, Any]:
        """The fields of DatasetConfig that were given."""
        names = ("kind", "domain", "split", "count", "instances", "seed", "downscale", "faces", "jpeg", "shard")
        given = {name: getattr(self, name) for name in (*names, "parts_dir")}
        given |= {"parts": self.part or None, "size": self.size and _size(self.size)}
        given |= {"depth": False if self.no_depth else None}
        if self.count is not None and self.instances is not None:
            raise SceneError(f"--count {self.count} and --instances {self.instances}: give one of them")
        return {name: value for name, value in given.items() if value is not None}


@dataclasses.dataclass(frozen=True, kw_only=True)
class DataValidate:
    """Check a data set: BOP and COCO layout, labels against images, checksums."""

    folder: Positional[Path]
    """Folder of the data set."""
    sample: int = 100
    """Images whose pixels are compared with their labels; everything else is read completely."""
    json: FlagCreatePairsOff[bool] = False
    """Print as JSON."""

    def run(self) -> None:
        """Print what is wrong, a line each; exit code 1 when anything is."""
        from scenes.validate import validate

        if self.sample < 0:
            raise SceneError(f"--sample {self.sample}: must not be negative")
        report = validate(self.folder, sample=self.sample)
        print(json.dumps(report.to_json(), indent=1) if self.json else report)
        if not report.ok:
            sys.exit(1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DataSheet:
    """Write a contact sheet: what the ranges that images are drawn from look like."""

    domain: Domain = "classic"
    """What draws the images."""
    kind: Kind = "crop"
    """Crops, windows or whole frames."""
    split: Split = "train"
    """Which lights, backgrounds and camera heights to draw from."""
    part: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME", help_behavior_hint=PARTS_HINT)] = ()
    """A part to show; may be given several times."""
    parts_dir: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    seed: int = 0
    """Seed of everything that is drawn."""
    out: Path = Path("runs/sheet.png")
    """The picture to write."""

    def run(self) -> None:
        """Draw and save."""
        from scenes.contact_sheet import write_contact_sheet
        from scenes.dataset_config import DatasetConfig
        from twin.part_cli import progress_bar

        config = DatasetConfig(
            domain=self.domain,
            kind=self.kind,
            split=self.split,
            parts=self.part,
            parts_dir=self.parts_dir,
            seed=self.seed,
        )
        with progress_bar(f"{self.domain} {self.kind}s") as advance:
            write_contact_sheet(config, self.out, progress=advance)
        print(self.out)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DataRecipes:
    """List the data sets that are known by name: `tagcell render --recipe NAME`."""

    json: FlagCreatePairsOff[bool] = False
    """Print them with all that they set as JSON."""

    def run(self) -> None:
        """Print one line a recipe."""
        from scenes.recipes import recipe, recipe_names

        recipes = {name: recipe(name) for name in recipe_names()}
        if self.json:
            print(json.dumps(recipes, indent=1))
            return
        for name, content in recipes.items():
            print(f"{name:22s} {content['about']}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Data:
    """Data sets: check one, show what they vary in, list recipes."""

    action: OmitSubcommandPrefixes[
        Annotated[DataValidate, subcommand("validate", prefix_name=False)]
        | Annotated[DataSheet, subcommand("sheet", prefix_name=False)]
        | Annotated[DataRecipes, subcommand("recipes", prefix_name=False)]
    ]

    def run(self) -> None:
        """Run the chosen action."""
        self.action.run()


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if not found:
        raise SceneError(f"--size {text!r}: give width and height in pixels, like 256x256")
    return int(found[1]), int(found[2])


def _option(name: str, value: Any) -> str:
    """An option as it was given."""
    if name == "depth":
        return "--no-depth"
    if name == "parts":
        return " ".join(f"--part {part}" for part in value)
    return f"--{name} {'x'.join(map(str, value)) if name == 'size' else value}"
