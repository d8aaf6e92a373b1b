"""Parametric solids of the three pieces of a USB Type-C receptacle, in millimetres, in one assembly frame.

Frame: x towards the mouth, y across the width, z up (the solder side is -z), origin at the centre of the opening of the
shell. Every piece is its own mirror image in y, as the real ones are, and nothing is added to tell the faces apart.

Sources: ``SPEC`` fixes the mating interface (opening 8.34 x 2.56, tongue 6.69 x 0.70, contact pitch 0.50);
``DRAWING`` is a typical published drawing of a hybrid mount receptacle (shell 8.94 x 3.16 x 7.35, legs 8.64 apart and
4.18 along, locating pegs of diameter 0.65, 5.78 apart). The remaining sizes are usual for stamped and moulded
connectors of this kind and are chosen so that the pieces assemble with the clearances in ``CLEARANCES_MM``.
"""

from __future__ import annotations

from collections.abc import Callable

from build123d import (  # pyright: ignore[reportMissingImports]
    Axis,
    Box,
    Cylinder,
    Plane,
    Pos,
    Rectangle,
    SlotOverall,
    Solid,
    chamfer,
    extrude,
    fillet,
)

SPEC = (
    "USB-IF, Universal Serial Bus Type-C Cable and Connector Specification, release 2.x, section 3.2 (receptacle "
    "interface): opening 8.34 x 2.56 mm, tongue 6.69 x 0.70 mm, contact pitch 0.50 mm"
)
DRAWING = (
    "Published drawings of through-hole and SMT hybrid USB Type-C receptacles (Korean Hroparts TYPE-C-31-M-12 and "
    "alike): shell 8.94 x 3.16 x 7.35 mm, mounting legs 8.64 x 4.18 mm apart, locating pegs of diameter 0.65 mm "
    "5.78 mm apart"
)

# Shell (`main`): drawn stainless steel tube of stadium section.
OPENING_WIDTH, OPENING_HEIGHT = 8.34, 2.56  # SPEC
SHEET = 0.30
SHELL_WIDTH, SHELL_HEIGHT, SHELL_LENGTH = OPENING_WIDTH + 2 * SHEET, OPENING_HEIGHT + 2 * SHEET, 7.35  # DRAWING
REAR_CUT = 1.20  # the lower half is cut back for the contact tails and the pegs
LEG_PITCH_Y, LEG_PITCH_X = 8.64, 4.18  # DRAWING
LEG_REAR_X, LEG_FRONT_WIDTH, LEG_REAR_WIDTH = -5.60, 1.10, 0.90
LEG_DEPTH, LEG_TAPER = 0.95, 0.25  # below the shell, and the chamfer that lets a leg find its hole
WINDOW_X, WINDOW_Y, WINDOW_LENGTH, WINDOW_WIDTH = -1.60, 2.10, 1.60, 0.90

# Moulding (`inserted`): tongue, flange, contacts.
TONGUE_WIDTH, TONGUE_HEIGHT, TONGUE_LENGTH = 6.69, 0.70, 4.45  # SPEC
TONGUE_TIP_X = -0.85
TONGUE_CHAMFER, TONGUE_CORNER = 0.15, 0.35
NOTCH_DEPTH, NOTCH_LENGTH, NOTCH_X = 0.45, 1.00, -2.90
CONTACTS, CONTACT_PITCH = 12, 0.50  # SPEC
RIB_WIDTH, RIB_HEIGHT, RIB_LENGTH, RIB_FRONT_X = 0.25, 0.03, 3.00, -1.45
FLANGE_CLEARANCE, FLANGE_LENGTH, FLANGE_HALF_WIDTH = 0.07, 1.60, 4.03
STEP_LENGTH = 0.90  # the lower half of the flange reaches further to the rear
PEG_PITCH, PEG_DIAMETER, PEG_DEPTH, PEG_X = 5.78, 0.65, 0.90, -6.75  # DRAWING
TAIL_WIDTH, TAIL_HEIGHT, TAIL_LENGTH = 0.20, 0.12, 0.90

# Cover (`top`): bent stainless steel sheet.
COVER_SHEET, COVER_CLEARANCE = 0.20, 0.05
COVER_INNER_WIDTH = SHELL_WIDTH + 2 * COVER_CLEARANCE
COVER_LENGTH, COVER_FLAP_DEPTH, COVER_BEND = 5.20, 1.50, 0.10  # bend: inner radius
REAR_FLAP_WIDTH, REAR_FLAP_DEPTH, RELIEF = 7.50, 2.00, 0.50
FRONT_TAB_WIDTH, FRONT_TAB_LENGTH = 5.00, 0.50

FLANGE_FRONT_X = TONGUE_TIP_X - TONGUE_LENGTH
FLANGE_REAR_X = FLANGE_FRONT_X - FLANGE_LENGTH
STEP_REAR_X = FLANGE_REAR_X - STEP_LENGTH
COVER_REAR_X = STEP_REAR_X - COVER_CLEARANCE - COVER_SHEET
COVER_FRONT_X = COVER_REAR_X + COVER_LENGTH
COVER_TOP_Z = SHELL_HEIGHT / 2 + COVER_CLEARANCE + COVER_SHEET

Features = dict[str, list[Solid]]
"""The solids that make up a piece, by the name of the feature."""

CLEARANCES_MM = {
    ("inserted", "main"): FLANGE_CLEARANCE,
    ("main", "top"): COVER_CLEARANCE,
    ("inserted", "top"): COVER_CLEARANCE,
}
"""Smallest gap between two assembled pieces."""


def main_features() -> Features:
    """The formed shell: stadium tube with a rear cut and two latch windows, and four solder legs."""
    section = SlotOverall(SHELL_WIDTH, SHELL_HEIGHT) - SlotOverall(OPENING_WIDTH, OPENING_HEIGHT)
    tube = extrude(Plane.YZ * section, amount=-SHELL_LENGTH)
    tube -= _box((-SHELL_LENGTH - 1, -SHELL_LENGTH + REAR_CUT), (-SHELL_WIDTH, SHELL_WIDTH), (-SHELL_HEIGHT, 0))
    for y in (-WINDOW_Y, WINDOW_Y):
        tube -= Pos(WINDOW_X, y, SHELL_HEIGHT / 2) * Box(WINDOW_LENGTH, WINDOW_WIDTH, 2 * SHEET + 0.2)
    legs = [
        _leg(x, side * LEG_PITCH_Y / 2, width)
        for side in (-1, 1)
        for x, width in ((LEG_REAR_X, LEG_REAR_WIDTH), (LEG_REAR_X + LEG_PITCH_X, LEG_FRONT_WIDTH))
    ]
    return {"tube": [tube], "leg": legs}


def inserted_features() -> Features:
    """The moulding: flange, tongue, pegs, contact ribs and contact tails."""
    radius = OPENING_HEIGHT / 2 - FLANGE_CLEARANCE
    section = Plane.YZ * (
        SlotOverall(OPENING_WIDTH - 2 * FLANGE_CLEARANCE, 2 * radius) & Rectangle(2 * FLANGE_HALF_WIDTH, 2 * radius)
    )
    flange = Pos(FLANGE_FRONT_X, 0, 0) * extrude(section, amount=-FLANGE_LENGTH - STEP_LENGTH)
    flange -= _box((STEP_REAR_X - 1, FLANGE_REAR_X), (-SHELL_WIDTH, SHELL_WIDTH), (0, SHELL_HEIGHT))
    peg_length = radius + PEG_DEPTH
    peg = Pos(PEG_X, 0, -peg_length / 2) * Cylinder(PEG_DIAMETER / 2, peg_length)
    ribs, posts, feet = [], [], []
    half, board = TONGUE_HEIGHT / 2 + RIB_HEIGHT, -SHELL_HEIGHT / 2
    for y in contact_ys():
        across = (y - RIB_WIDTH / 2, y + RIB_WIDTH / 2)
        ribs.append(_box((RIB_FRONT_X - RIB_LENGTH, RIB_FRONT_X), across, (-half, half)))
        across = (y - TAIL_WIDTH / 2, y + TAIL_WIDTH / 2)
        posts.append(_box((STEP_REAR_X, STEP_REAR_X + TAIL_HEIGHT), across, (board, board / 2)))
        foot_front = STEP_REAR_X + TAIL_HEIGHT
        feet.append(_box((foot_front - TAIL_LENGTH, foot_front), across, (board, board + TAIL_HEIGHT)))
    pegs = [Pos(0, side * PEG_PITCH / 2, 0) * peg for side in (-1, 1)]
    return {"flange": [flange], "tongue": [_tongue()], "peg": pegs, "rib": ribs, "post": posts, "foot": feet}


def top_features() -> Features:
    """The bent cover: plate with two side flaps, plate with the rear flap between corner reliefs, front tab."""
    inner, outer = COVER_INNER_WIDTH, COVER_INNER_WIDTH + 2 * COVER_SHEET
    section = _bent(outer, COVER_FLAP_DEPTH, both=True) - _bent(inner, COVER_FLAP_DEPTH, both=True, inside=True)
    sides = Pos(COVER_FRONT_X, 0, 0) * extrude(Plane.YZ * section, amount=-(COVER_LENGTH - RELIEF))
    section = _bent(COVER_LENGTH, REAR_FLAP_DEPTH, both=False)
    section -= Pos(COVER_SHEET, 0) * _bent(COVER_LENGTH, REAR_FLAP_DEPTH, both=False, inside=True)
    middle = (COVER_REAR_X + COVER_FRONT_X) / 2
    rear = Pos(middle, 0, 0) * extrude(Plane.XZ * section, amount=REAR_FLAP_WIDTH / 2, both=True)
    plate = (COVER_TOP_Z - COVER_SHEET, COVER_TOP_Z)
    half = FRONT_TAB_WIDTH / 2
    tab = _box((COVER_FRONT_X - 0.1, COVER_FRONT_X + FRONT_TAB_LENGTH), (-half, half), plate)
    return {"sides": [sides], "rear": [rear], "tab": [tab]}


FEATURES: dict[str, Callable[[], Features]] = {
    "inserted": inserted_features,
    "main": main_features,
    "top": top_features,
}
"""Makers of the three pieces, by part name."""


def fuse(features: Features) -> Solid:
    """One solid from overlapping features.

    Raises ValueError when they do not hang together.
    """
    first, *others = (solid for group in features.values() for solid in group)
    for other in others:
        first = first + other
    solids = first.clean().solids()
    if len(solids) != 1:
        raise ValueError(f"the piece falls apart into {len(solids)} solids; its features must overlap")
    return solids[0]


def assembly() -> dict[str, Solid]:
    """The three pieces where they sit in a finished receptacle, by part name."""
    return {name: fuse(make()) for name, make in FEATURES.items()}


def intersection_volume_mm3(a: Solid, b: Solid) -> float:
    """Volume that two pieces share (0 when they fit)."""
    common = a & b
    return 0.0 if common is None else float(sum(solid.volume for solid in common.solids()))


def contact_ys() -> list[float]:
    """Where the contacts of one row are across the width, in mm."""
    return [(i - (CONTACTS - 1) / 2) * CONTACT_PITCH for i in range(CONTACTS)]


def _tongue() -> Solid:
    front, rear = TONGUE_TIP_X, FLANGE_FRONT_X - 0.1
    half = TONGUE_WIDTH / 2
    tongue = _box((rear, front), (-half, half), (-TONGUE_HEIGHT / 2, TONGUE_HEIGHT / 2))
    tip = tongue.faces().sort_by(Axis.X)[-1]
    tongue = chamfer(tip.edges().filter_by(Axis.Z), TONGUE_CORNER)
    tongue = chamfer(tongue.faces().sort_by(Axis.X)[-1].edges().filter_by(Axis.Y), TONGUE_CHAMFER)
    for side in (-1, 1):
        tongue -= Pos(NOTCH_X, side * half, 0) * Box(NOTCH_LENGTH, 2 * NOTCH_DEPTH, 2 * TONGUE_HEIGHT)
    return tongue


def _leg(x: float, y: float, width: float) -> Solid:
    bottom = -SHELL_HEIGHT / 2 - LEG_DEPTH
    leg = _box((x - width / 2, x + width / 2), (y - SHEET / 2, y + SHEET / 2), (bottom, 0))
    return chamfer(leg.faces().sort_by(Axis.Z)[0].edges().filter_by(Axis.Y), LEG_TAPER)


def _bent(width: float, depth: float, *, both: bool, inside: bool = False) -> Rectangle:
    """Section of a bent sheet's outer (or inner) outline: its top corners, or the left one only, are rounded."""
    gap = COVER_SHEET if inside else 0.0
    radius = COVER_BEND if inside else COVER_BEND + COVER_SHEET
    outline = Pos(0, COVER_TOP_Z - gap - (depth - gap) / 2) * Rectangle(width, depth - gap)
    corners = outline.vertices().group_by(Axis.Y)[-1].sort_by(Axis.X)
    return fillet(corners if both else corners[:1], radius)


def _box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Solid:
    size = [b - a for a, b in (x, y, z)]
    return Pos(*((a + b) / 2 for a, b in (x, y, z))) * Box(*size)
