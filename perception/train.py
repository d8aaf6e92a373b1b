"""``python -m perception.train NETWORK --data DIR --val DIR --minutes M --out DIR``: train one network.

Each network's module has a frozen config dataclass that derives from ``TrainingConfig`` and a function that takes it;
``TRAINERS`` names them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

import tyro

from cad.parts import CadError
from perception.estimates import PerceptionError

FLAT = (tyro.conf.OmitArgPrefixes,)
"""Config fields become plain flags (``--minutes``, not ``--config.minutes``)."""

TRAINERS: dict[str, str] = {
    "segmentation": "perception.train_segmentation:train_segmentation",
    "maskrcnn": "perception.train_maskrcnn:train_maskrcnn",
    "classifier": "perception.train_crops:train_classifier",
    "verifier": "perception.train_crops:train_verifier",
    "keypoints": "perception.train_crops:train_keypoints",
    "pvnet": "perception.pvnet_baseline_training:train_pvnet",
    "choice": "perception.fit_choice:fit_choice",
}
"""Network name -> "module:function"; the function takes its config as ``config``, which tyro reads."""


def trainer(name: str) -> Callable[..., Any]:
    """The function that trains the network called ``name``; raises PerceptionError with the names there are."""
    if name not in TRAINERS:
        raise PerceptionError(f"no network is called {name!r}; networks there are: {', '.join(TRAINERS)}")
    module, function = TRAINERS[name].split(":")
    return getattr(import_module(module), function)


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, train, return the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"{__doc__}\nnetworks: {', '.join(TRAINERS)}; each takes --help")
        return 0 if arguments else 2
    try:
        tyro.cli(trainer(arguments[0]), prog=f"perception.train {arguments[0]}", args=arguments[1:], config=FLAT)
    except (PerceptionError, CadError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
