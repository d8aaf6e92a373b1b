"""The UR5e's links as solids, in millimetres, each in its own Denavit-Hartenberg frame (``cad.robot``).

Published (Universal Robots, UR5e data sheet and user manual): joint positions (the Denavit-Hartenberg table), footprint
of diameter 149 with four bolts of 8.5 on a circle of 132, tool flange ISO 9409-1-50-4-M6 (diameter 63, 4 x M6 on 50).
The other sizes are ours, chosen so that the housings of neighbouring links meet at their seams: the upper arm runs 138
beside the shoulder's centre and the forearm 7. They shape what is seen, never the kinematics.
"""

from __future__ import annotations

from build123d import Cylinder, PolarLocations, Pos, Rot, Shape  # pyright: ignore[reportMissingImports]

from cad.models.solids import Finish, Piece, barrel, box, fuse
from cad.robot import UR5E

HOUSING = Finish(rgba=(0.78, 0.79, 0.80, 1.0), metallic=0.3, roughness=0.45)
TUBE = Finish(rgba=(0.66, 0.67, 0.69, 1.0), metallic=0.8, roughness=0.35)
CAP = Finish(rgba=(0.44, 0.61, 0.74, 1.0), metallic=0.0, roughness=0.5)
RING = Finish(rgba=(0.08, 0.08, 0.09, 1.0), metallic=0.0, roughness=0.6)

D1, A2, A3, D4, D5, D6 = (1e3 * v for v in (UR5E.d[0], -UR5E.a[1], -UR5E.a[2], *UR5E.d[3:]))

FOOT_RADIUS, FOOT_HEIGHT = 74.5, 12.0
BOLT_CIRCLE_RADIUS, BOLT_RADIUS = 66.0, 4.25
BASE_RADIUS, BASE_TOP = 60.0, 84.0
RING_WIDTH, RING_STEP = 6.0, 1.5
"""A seam ring's width, and how far it lies below the housings."""
CAP_HEIGHT = 15.0
SHOULDER_RADIUS, SHOULDER_STUB_RADIUS, SHOULDER_TOP, SHOULDER_SEAM = 60.0, 58.0, 46.0, 72.0
"""Radius of joints 1 and 2 and of the stub between them, lid seat above joint 2, seam of joint 2 beside joint 1."""
UPPER_ARM_OFFSET, UPPER_ARM_BACK = 138.0, 186.0
ELBOW_RADIUS, ELBOW_SEAM = 55.0, 64.0
UPPER_TUBE_RADIUS, UPPER_COLLAR_RADIUS = 44.0, 50.0
FOREARM_OFFSET, FOREARM_BACK = 7.0, -50.0
FOREARM_TUBE_RADIUS, FOREARM_COLLAR_RADIUS = 37.0, 42.0
WRIST_RADIUS, WRIST_STUB_RADIUS, WRIST_SEAM = 43.0, 41.0, 50.0
"""Radius of the wrist joints and of wrist 1's stub to the next one; seam of the next joint beside this one's axis."""
FOREARM_SEAM = 64.0
"""Seam of joint 4 beside the forearm's frame."""
WRIST_BACK = 38.0
"""Seat of the lids of wrists 1 and 2 beside the axis of the next joint."""
FLANGE_RADIUS, FLANGE_DISC_RADIUS = 37.5, 31.5
FACING_X, FACING_MINUS_X, FACING_Y, FACING_MINUS_Y = Rot(0, 90, 0), Rot(0, -90, 0), Rot(-90, 0, 0), Rot(90, 0, 0)
"""Turn what was made along z to the named direction."""


def ur5e_pieces() -> list[Piece]:
    """Every solid of the arm, base to wrist 3."""
    return [*_base(), *_shoulder(), *_upper_arm(), *_forearm(), *_wrist(1), *_wrist(2), *_wrist_3()]


def _base() -> list[Piece]:
    foot = barrel(FOOT_RADIUS, 0, FOOT_HEIGHT, round_high=3)
    foot -= [place * Cylinder(BOLT_RADIUS, 3 * FOOT_HEIGHT) for place in PolarLocations(BOLT_CIRCLE_RADIUS, 4, 45)]
    column = barrel(BASE_RADIUS, 0, BASE_TOP, round_high=1.5)
    connector = Rot(0, -90, 0) * box((20, 52), (-22, 22), (0, BASE_RADIUS + 9), rounding=4)
    body = fuse([foot, column, connector])
    return _pieces("base", body=body, ring=barrel(BASE_RADIUS - RING_STEP, BASE_TOP, BASE_TOP + RING_WIDTH))


def _shoulder() -> list[Piece]:
    low = BASE_TOP + RING_WIDTH - D1
    upright = FACING_Y * barrel(SHOULDER_RADIUS, low, SHOULDER_TOP, round_low=1.5, round_high=3)
    stub_end = SHOULDER_SEAM - RING_WIDTH
    stub = barrel(SHOULDER_STUB_RADIUS, 0, stub_end, round_high=1.5)
    return _pieces(
        "shoulder",
        body=fuse([upright, stub]),
        cap=FACING_Y * _cap(SHOULDER_RADIUS, SHOULDER_TOP),
        ring=barrel(SHOULDER_STUB_RADIUS - RING_STEP, stub_end, SHOULDER_SEAM),
    )


def _upper_arm() -> list[Piece]:
    """Frame 2: shoulder axis at x = 425, elbow axis at x = 0, both along z."""
    shoulder = Pos(A2, 0, 0) * barrel(SHOULDER_RADIUS, SHOULDER_SEAM, UPPER_ARM_BACK, round_low=1.5, round_high=3)
    elbow = barrel(ELBOW_RADIUS, ELBOW_SEAM + RING_WIDTH, UPPER_ARM_BACK, round_low=1.5, round_high=3)
    collars = [
        Pos(A2, 0, UPPER_ARM_OFFSET - 9) * FACING_MINUS_X * barrel(UPPER_COLLAR_RADIUS, 0, 90, round_high=4),
        Pos(0, 0, UPPER_ARM_OFFSET - 9) * FACING_X * barrel(UPPER_COLLAR_RADIUS, 0, 84, round_high=4),
    ]
    tube = Pos(80, 0, UPPER_ARM_OFFSET - 9) * FACING_X * barrel(UPPER_TUBE_RADIUS, 0, A2 - 80 - 86)
    return _pieces(
        "upper_arm",
        body_shoulder=fuse([shoulder, collars[0]]),
        body_elbow=fuse([elbow, collars[1]]),
        tube=tube,
        cap_shoulder=Pos(A2, 0, 0) * _cap(SHOULDER_RADIUS, UPPER_ARM_BACK),
        cap_elbow=_cap(ELBOW_RADIUS, UPPER_ARM_BACK),
        ring=barrel(ELBOW_RADIUS - RING_STEP, ELBOW_SEAM, ELBOW_SEAM + RING_WIDTH),
    )


def _forearm() -> list[Piece]:
    """Frame 3: elbow axis at x = 392.2, wrist 1 axis at x = 0, both along z."""
    elbow = Pos(A3, 0, 0) * barrel(ELBOW_RADIUS, FOREARM_BACK, ELBOW_SEAM, round_low=8, round_high=1.5)
    wrist = barrel(WRIST_RADIUS, FOREARM_OFFSET - 41, FOREARM_SEAM - RING_WIDTH, round_low=8, round_high=1.5)
    collars = [
        Pos(A3, 0, FOREARM_OFFSET) * FACING_MINUS_X * barrel(FOREARM_COLLAR_RADIUS + 2, 0, 82, round_high=4),
        Pos(0, 0, FOREARM_OFFSET) * FACING_X * barrel(FOREARM_COLLAR_RADIUS - 1.5, 0, 66, round_high=3),
    ]
    tube = Pos(62, 0, FOREARM_OFFSET) * FACING_X * barrel(FOREARM_TUBE_RADIUS, 0, A3 - 62 - 78)
    return _pieces(
        "forearm",
        body_elbow=fuse([elbow, collars[0]]),
        body_wrist=fuse([wrist, collars[1]]),
        tube=tube,
        ring=barrel(WRIST_RADIUS - RING_STEP, FOREARM_SEAM - RING_WIDTH, FOREARM_SEAM),
    )


def _wrist(number: int) -> list[Piece]:
    """Wrist 1 (frame 4, joint 4 along y) and wrist 2 (frame 5, joint 5 along -y): a barrel and a stub along z."""
    seam = FOREARM_SEAM - D4 if number == 1 else WRIST_SEAM - D5
    turn = FACING_Y if number == 1 else FACING_MINUS_Y
    upright = turn * barrel(WRIST_RADIUS, seam, WRIST_BACK, round_low=1.5, round_high=2)
    stub_end = WRIST_SEAM - RING_WIDTH
    radius = WRIST_STUB_RADIUS if number == 1 else FLANGE_RADIUS + 0.5
    return _pieces(
        f"wrist_{number}",
        body=fuse([upright, barrel(radius, 0, stub_end, round_high=1)]),
        cap=turn * _cap(WRIST_RADIUS, WRIST_BACK),
        ring=barrel(radius - RING_STEP, stub_end, WRIST_SEAM),
    )


def _wrist_3() -> list[Piece]:
    """Frame 6: the flange face is z = 0."""
    drum = barrel(FLANGE_RADIUS, WRIST_SEAM - D6, -6.5, round_low=0.8, round_high=1.5)
    connector = Pos(0, FLANGE_RADIUS - 4, -24) * Rot(-90, 0, 0) * Cylinder(7, 20)
    disc = barrel(FLANGE_DISC_RADIUS, -8, 0)
    disc -= [place * Cylinder(3, 20) for place in PolarLocations(25, 4, 45)]
    disc -= barrel(15.75, -6.2, 1)
    return _pieces("wrist_3", body=fuse([drum, connector]), tube=disc)


def _cap(radius: float, seat: float) -> Shape:
    """A joint's lid on ``seat``: a rim, a domed top and a shallow round recess."""
    rim = barrel(radius - 1, seat, seat + 3)
    dome = barrel(radius - 3.5, seat, seat + CAP_HEIGHT, round_high=8)
    recess = barrel(0.5 * radius, seat + CAP_HEIGHT - 1.2, seat + CAP_HEIGHT + 1)
    return fuse([rim, dome]) - recess


def _pieces(link: str, **shapes: Shape) -> list[Piece]:
    """Pieces of a link; the first word of each key names the finish."""
    finishes = {"body": HOUSING, "tube": TUBE, "cap": CAP, "ring": RING}
    return [
        Piece(name=f"ur5e_{link}_{key}", body=f"ur5e_{link}", shape=shape, finish=finishes[key.split("_")[0]])
        for key, shape in shapes.items()
    ]
