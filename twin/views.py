"""Ways in which a camera can look at the board again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

LookKind = Literal["exposure", "park", "nudge"]
"""Another exposure time, the arm parked elsewhere, a push of the part."""


@dataclass(frozen=True, kw_only=True)
class View:
    """How the camera looks: ``exposure`` times its usual exposure time, the arm where it parks or ``elsewhere``."""

    exposure: float = 1.0
    elsewhere: bool = False

    @property
    def kind(self) -> LookKind:
        """What it takes to look like that."""
        return "park" if self.elsewhere else "exposure"

    def __str__(self) -> str:
        if self == USUAL:
            return "usual"
        return "arm elsewhere" if self.elsewhere else f"exposure {self.exposure:g}"


USUAL = View()
