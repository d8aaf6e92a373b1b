"""Learning curves: what is wrong on validation data after equal training on fewer images, and minute by minute.

``python -m benchmarks.learning --data data --out runs/learning`` trains the segmenter and the joint classifier anew for
every number of images, prints a table and draws ``learning.png``. ``--curves NAME.csv ...`` adds the errors against
minutes of runs that are there. A run that was stopped goes on where it was; one that is finished is not repeated.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.tables import Section, show
from cad.files import replacing
from perception.bop_files import read_json
from perception.training_curves import VALIDATION, read_curves
from twin.robot import TwinError
from twin.training import LANES
from twin.training_lanes import run_lanes

ERRORS = {
    "segmentation": {"missed at overlap 0.5": "recall50", "1 - AP50": "ap50"},
    "classifier": {"wrong reading": "equal_view", "wrong class": "class"},
}
"""Errors by network, each 1 minus a figure of validation data."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """``data`` holds the data sets of ``tagcell train``. Every run learns for ``minutes``, two at a time."""

    data: Path = Path("data")
    out: Path = Path("runs/learning")
    images: tuple[int, ...] = (250, 1000, 4000, 16000)
    minutes: float = 8.0
    curves: tuple[Path, ...] = ()
    seed: int = 0


def settings(config: Config, network: str, images: int) -> dict[str, Any]:
    """What the config of a network's run on that many images is made of."""
    job = next(job for lane in LANES for job in lane if job.network == network)
    return {
        "data": tuple(config.data / name for name in job.data),
        "val": tuple(config.data / name for name in job.val),
        "out": config.out / f"{network}_{images}",
        "images": images,
        "minutes": config.minutes,
        "validate_s": 1e6,
        "seed": config.seed,
    }


def learn(config: Config) -> dict[str, dict[int, dict[str, float]]]:
    """Figures by network and number of images."""
    lanes = [[(network, settings(config, network, images)) for images in config.images] for network in ERRORS]
    run_lanes(lanes, at_once=os.cpu_count() or 1)
    return {
        network: {
            images: read_json(config.out / f"{network}_{images}" / f"{network}.json")["figures"]
            for images in config.images
        }
        for network in ERRORS
    }


def draw(figures: dict[str, dict[int, dict[str, float]]], config: Config) -> Path:
    """``learning.png``: errors against images, and beside them against the minutes of ``curves``."""
    figure = Figure(figsize=(9.0, 3.8), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2 if config.curves else 1, sharey=True, squeeze=False)[0]
    for network, names in ERRORS.items():
        for label, name in names.items():
            wrong = [1.0 - figures[network][images][name] for images in config.images]
            panels[0].plot(config.images, wrong, marker="o", label=f"{network}: {label}")
    panels[0].set(xscale="log", yscale="log", ylabel="share on validation data")
    panels[0].set_xlabel(f"images, {config.minutes:g} minutes each")
    for path in config.curves:
        curves = read_curves(path)
        for label, name in ERRORS.get(path.stem, {}).items():
            values = curves.get(VALIDATION + name)
            if values is not None:
                seen = np.isfinite(values)
                panels[1].plot(curves["minutes"][seen], 1.0 - values[seen], marker=".", label=f"{path.stem}: {label}")
        panels[1].set_xlabel("minutes of training on all images")
    for axes in panels:
        axes.grid(color="0.92", which="both")
        if axes.lines:
            axes.legend(fontsize=8)
    path = config.out / "learning.png"
    with replacing(path) as aside:
        figure.savefig(aside)
    return path


def main(config: Config) -> None:
    """Train what is missing, print the table and draw the picture."""
    figures = learn(config)
    sections = [
        Section(
            title=f"{network}: errors on validation data after {config.minutes:g} minutes",
            columns=("images", *names),
            rows=[
                (str(images), *(f"{1.0 - row[name]:.4f}" for name in names.values()))
                for images, row in figures[network].items()
            ],
        )
        for network, names in ERRORS.items()
    ]
    show(sections, f"seed {config.seed}, one thread each, two at a time", as_json=False)
    print(draw(figures, config))


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, description=__doc__))
    except TwinError as error:
        sys.exit(f"error: {error}")
