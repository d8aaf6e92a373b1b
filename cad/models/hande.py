"""The Hand-E and our fingertips as solids, in millimetres, in the frames of ``cad.gripper``.

Published sizes (coupling, body diameter and height, stroke) and our own (carriages, fingertips) are told apart there;
the body's contours are ours: a round body with two flats and a groove in which the racks slide.
"""

from __future__ import annotations

from build123d import Axis, Polyline, Pos, Rot, Shape, chamfer, loft, make_face  # pyright: ignore[reportMissingImports]

from cad import gripper
from cad.models.solids import Finish, Piece, barrel, box

BLACK = Finish(rgba=(0.10, 0.10, 0.11, 1.0), metallic=0.1, roughness=0.5)
GREY = Finish(rgba=(0.35, 0.36, 0.38, 1.0), metallic=0.4, roughness=0.5)
STEEL = Finish(rgba=(0.62, 0.63, 0.65, 1.0), metallic=0.9, roughness=0.3)
ALUMINIUM = Finish(rgba=(0.80, 0.81, 0.82, 1.0), metallic=0.7, roughness=0.4)
COATING = Finish(rgba=(0.72, 0.36, 0.10, 1.0), metallic=0.0, roughness=0.8)


def _mm(*lengths_m: float) -> tuple[float, ...]:
    return tuple(1e3 * v for v in lengths_m)


GAP, LENGTH, WIDTH, HEIGHT = _mm(
    gripper.CARRIAGE_GAP_M, gripper.CARRIAGE_LENGTH_M, gripper.CARRIAGE_WIDTH_M, gripper.CARRIAGE_HEIGHT_M
)
ROOT_Z = -1e3 * gripper.FINGER_LENGTH_M
BLADE, BLADE_WIDTH, BLADE_HEIGHT, COAT = _mm(
    gripper.PAD_THICKNESS_M, gripper.PAD_WIDTH_M, gripper.PAD_HEIGHT_M, gripper.PAD_COATING_M
)
ROOT, ROOT_WIDTH = _mm(gripper.FINGER_ROOT_THICKNESS_M, gripper.FINGER_ROOT_WIDTH_M)

RACK_WIDTH, RACK_DEPTH = _mm(gripper.RACK_WIDTH_M, gripper.RACK_DEPTH_M)
COUPLING_TOP = 1e3 * gripper.COUPLING_HEIGHT_M
BODY_TOP = 1e3 * (gripper.COUPLING_HEIGHT_M + gripper.BODY_HEIGHT_M)
RADIUS = 1e3 * gripper.BODY_RADIUS_M
FLAT_Y, SHOULDER_Z = 29.0, 66.0
"""The flats' distance from the axis and the height from the flange at which they begin."""
GROOVE_CLEARANCE = 0.5
"""Between the rack and each wall of the groove."""
BAND_Z = 58.0


def hande_pieces() -> list[Piece]:
    """Coupling, body and both fingers with carriage, tip and pad."""
    fingers = []
    for side, turn in (("left", Rot(0, 0, 0)), ("right", Rot(0, 0, 180))):
        body = f"hande_{side}"
        fingers += [
            Piece(name=f"{body}_rack", body=body, shape=turn * _rack(), finish=STEEL),
            Piece(name=f"{body}_carriage", body=body, shape=turn * _carriage(), finish=GREY),
            Piece(name=f"{body}_tip", body=body, shape=turn * _tip(), finish=ALUMINIUM),
            Piece(name=f"{body}_pad", body=body, shape=turn * _pad(), finish=COATING),
        ]
    return [*_base(), *fingers]


def _base() -> list[Piece]:
    coupling = barrel(RADIUS, 0, COUPLING_TOP - 0.8, round_low=1.5)
    coupling += box((-9, 9), (0, RADIUS + 5), (1, COUPLING_TOP - 2), rounding=2)
    seam = barrel(RADIUS - 1.2, COUPLING_TOP - 0.8, COUPLING_TOP + 0.8)
    body = barrel(RADIUS, COUPLING_TOP + 0.8, BODY_TOP, round_low=1, round_high=4)
    for y in ((-60, -FLAT_Y), (FLAT_Y, 60)):
        body -= box((-60, 60), y, (SHOULDER_Z, BODY_TOP + 1))
    half, depth = RACK_WIDTH / 2 + GROOVE_CLEARANCE, RACK_DEPTH + GROOVE_CLEARANCE
    body -= box((-60, 60), (-half, half), (BODY_TOP - depth, BODY_TOP + 1))
    band = barrel(RADIUS + 0.25, BAND_Z - 1.5, BAND_Z + 1.5) - barrel(RADIUS - 1, BAND_Z - 3, BAND_Z + 3)
    parts = (("coupling", coupling, GREY), ("seam", seam, BLACK), ("body", body, BLACK), ("band", band, ALUMINIUM))
    return [Piece(name=f"hande_{n}", body="hande_base", shape=s, finish=f) for n, s, f in parts]


def _rack() -> Shape:
    """The slider in the body's groove, in the left finger's frame."""
    top = ROOT_Z - HEIGHT
    return box((GAP, LENGTH), (-RACK_WIDTH / 2, RACK_WIDTH / 2), (top - RACK_DEPTH, top))


def _carriage() -> Shape:
    block = box((GAP, LENGTH), (-WIDTH / 2, WIDTH / 2), (ROOT_Z - HEIGHT, ROOT_Z), rounding=1.5)
    block = chamfer(block.faces().sort_by(Axis.Z)[-1].edges(), 1)
    for y in (-7, 7):
        block -= Pos(LENGTH / 2 + 3, y, ROOT_Z) * barrel(2.2, -3, 1)
    return block


def _tip() -> Shape:
    """The milled finger: a straight blade behind the pad and a taper to the carriage."""
    blade = box((COAT, BLADE), (-BLADE_WIDTH / 2, BLADE_WIDTH / 2), (-BLADE_HEIGHT, 0))
    neck = loft([_section(BLADE, BLADE_WIDTH, -BLADE_HEIGHT), _section(ROOT, ROOT_WIDTH, ROOT_Z)])
    return blade + neck


def _section(thickness: float, width: float, z: float) -> Shape:
    corners = [(COAT, -width / 2), (thickness, -width / 2), (thickness, width / 2), (COAT, width / 2)]
    return make_face(Polyline(*[(x, y, z) for x, y in corners], close=True))


def _pad() -> Shape:
    return box((0, COAT), (-BLADE_WIDTH / 2, BLADE_WIDTH / 2), (-BLADE_HEIGHT, 0))
