"""Figures that an evaluation is held against: the paper's, and those that Tagcell sets itself.

The paper is "Image-Based Pose Estimation of Sub-Centimeter Industrial Parts for Automated Assembly". Its Table 2 is of
2,000 synthetic images of its own, all parts, none declined. The values of its Table 1 are not available.
"""

from __future__ import annotations

from dataclasses import dataclass

PAPER_REFINED: dict[str, dict[str, float]] = {
    "inserted": {"e_x_mm": 0.57, "e_y_mm": 0.56, "e_z_mm": 1.02, "e_theta_deg": 2.52},
    "main": {"e_x_mm": 0.62, "e_y_mm": 0.59, "e_z_mm": 0.97, "e_theta_deg": 2.60},
    "top": {"e_x_mm": 0.99, "e_y_mm": 0.98, "e_z_mm": 1.29, "e_theta_deg": 2.55},
    "all": {"e_x_mm": 0.73, "e_y_mm": 0.71, "e_z_mm": 1.09, "e_theta_deg": 2.56},
}
"""Means of the paper's Table 2 by part after its refinement; "all" is the mean of the three."""
PAPER_RAW: dict[str, dict[str, float]] = {
    "inserted": {"e_x_mm": 0.57, "e_y_mm": 0.56, "e_z_mm": 62.0, "e_theta_deg": 3.39},
    "main": {"e_x_mm": 0.62, "e_y_mm": 0.59, "e_z_mm": 64.2, "e_theta_deg": 3.85},
    "top": {"e_x_mm": 0.99, "e_y_mm": 0.98, "e_z_mm": 105.4, "e_theta_deg": 3.09},
    "all": {"e_x_mm": 0.73, "e_y_mm": 0.71, "e_z_mm": 77.2, "e_theta_deg": 3.44},
}
"""The same before refinement; of x and y the paper gives one value."""

MSSD_MM = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Largest surface distances at which recall is given; BOP's own are too coarse for parts of this size."""
BAD_SHARE = 0.01
"""Largest share of wrong branches among accepted estimates."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """A figure's name, the value it must reach and the one it aims at; ``least``: whether larger is better."""

    name: str
    required: float
    aim: float | None = None
    least: bool = True

    def met(self, value: float) -> bool:
        """Whether a measured value is good enough."""
        return value >= self.required if self.least else value <= self.required

    def wanted(self) -> str:
        """For people: the required value, the aim behind it in brackets."""
        aim = f" ({self.aim:g})" if self.aim is not None else ""
        return f"{'≥' if self.least else '≤'} {self.required:g}{aim}"


ACCEPTED_SHARE = "accepted share"
"""It counts as reached only if no more than BAD_SHARE of the accepted are wrong."""
_NAMES = (
    "recall at IoU 0.5",
    "precision at IoU 0.5",
    "mask mIoU",
    "branch right, all detections",
    ACCEPTED_SHARE,
    "e_x mean (mm), accepted",
    "e_x p95 (mm), accepted",
    "e_y mean (mm), accepted",
    "e_y p95 (mm), accepted",
    "e_z mean (mm), accepted",
    "e_theta median (deg), accepted, branch right",
    "e_theta p95 (deg), accepted, branch right",
    "wrong among accepted",
    "parts",
)
_LARGER_IS_BETTER = {*_NAMES[:5], "parts"}
_VALUES: dict[str, tuple[tuple[float, float | None], ...]] = {
    "classic": ((0.98, 0.998), (0.98, 0.998), (0.95, None), (0.98, 0.998), (0.93, 0.98))
    + ((0.03, None), (0.10, None)) * 2
    + ((0.10, None), (0.1, None), (0.5, None), (BAD_SHARE, None), (600, None)),
    "filament": ((0.97, 0.99), (0.97, 0.99), (0.94, None), (0.96, 0.99), (0.80, 0.95))
    + ((0.04, None), (0.12, None)) * 2
    + ((0.10, None), (0.1, None), (0.6, None), (BAD_SHARE, None), (600, None)),
    "mitsuba": ((0.95, 0.98), (0.95, 0.98), (0.92, None), (0.93, 0.98), (0.70, 0.9))
    + ((0.05, None), (0.15, None)) * 2
    + ((0.10, None), (0.15, None), (0.8, None), (BAD_SHARE, None), (300, None)),
}

GOALS: dict[str, tuple[Goal, ...]] = {
    domain: tuple(
        Goal(name=name, required=required, aim=aim, least=name in _LARGER_IS_BETTER)
        for name, (required, aim) in zip(_NAMES, values, strict=True)
    )
    for domain, values in _VALUES.items()
}
"""What is wanted of each domain, over whole frames."""
