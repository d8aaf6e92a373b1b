"""The Robotiq Hand-E with fingertips of our own: limits, masses, dimensions and the tool frame.

Frame ``flange`` is the arm's flange. Frame ``tcp`` lies between the fingertips at their lower ends, +z out of the tool,
+x along the closing direction. Body ``hande_base`` sits in ``flange``; bodies ``hande_left`` (slides along +x) and
``hande_right`` (slides along -x) sit in ``tcp`` while the gripper is closed, so each slides by half the opening.
"""

from __future__ import annotations

import numpy as np

from cad.primitives import Primitive, box_between, cylinder_between
from cad.spatial import Array, transform

# Published: Robotiq, "Hand-E Gripper Instruction Manual", section 6 (specifications).
STROKE_M = 0.050
"""Largest opening between the pads."""
FORCE_RANGE_N = (20.0, 130.0)
"""Adjustable force of each finger: the manual's payload is ``2 F x friction / safety`` with F = 130 N at most (section
6, "Payload and force"); older data sheets state 185 N."""
SPEED_RANGE_M_S = (0.020, 0.150)
"""Adjustable closing speed of the opening between the pads."""
COUNTS = 255
"""Position, speed and force are one byte each on the wire: 0 is fully open, 255 fully closed."""

# Published CAD of the Hand-E and its I/O coupling (Robotiq), as the ROS packages made from it give the figures.
COUPLING_HEIGHT_M = 0.011
COUPLING_RADIUS_M = 0.0375
COUPLING_MASS_KG = 0.119
BODY_HEIGHT_M = 0.099
BODY_RADIUS_M = 0.0375
BODY_MASS_KG = 0.86387
BODY_COM_M = (0.0, 0.0, COUPLING_HEIGHT_M + 0.04607)
"""Centre of mass of the body in ``flange``."""
BODY_MOMENTS_KG_M2 = (1.01756e-3, 1.028041e-3, 0.48981e-3)
CARRIAGE_MASS_KG = 0.03804
"""One finger with its holder."""

# Ours: the holder plate that bolts to the finger rack and the fingertip milled for parts under a centimetre.
CARRIAGE_HEIGHT_M = 0.012
CARRIAGE_LENGTH_M = 0.018
"""Extent along x of one carriage, from the pad plane outwards."""
CARRIAGE_WIDTH_M = 0.022
"""Extent along y of one carriage."""
CARRIAGE_GAP_M = 0.0005
"""A carriage stands back from the pad plane by this much so that only the pads meet."""
FINGER_LENGTH_M = 0.025
"""From the carriage to the tip."""
FINGER_ROOT_THICKNESS_M = 0.008
"""Thickness along x where the finger leaves the carriage; tapers down to the blade."""
FINGER_ROOT_WIDTH_M = 0.010
"""Width along y where the finger leaves the carriage."""
PAD_WIDTH_M = 0.006
"""Along y."""
PAD_HEIGHT_M = 0.010
"""Along z, from the tip up: the straight blade. Its flat face is the pad."""
PAD_THICKNESS_M = 0.0025
"""Along x: the whole blade, pad coating included."""
PAD_COATING_M = 0.0005
"""Thickness along x of the polyurethane coating on the blade."""
PAD_FRICTION = 0.8
"""Polyurethane on metal and plastic, dry (typical)."""
FINGER_MASS_KG = 0.006
"""One aluminium fingertip of these dimensions."""

FINGER_BASE_Z_M = COUPLING_HEIGHT_M + BODY_HEIGHT_M + CARRIAGE_HEIGHT_M
TCP_Z_M = FINGER_BASE_Z_M + FINGER_LENGTH_M
"""Flange to the tip of the fingers: 147 mm."""

T_FLANGE_TCP: Array = transform(t=[0.0, 0.0, TCP_Z_M])
T_TCP_LEFT_PAD: Array = transform(t=[PAD_THICKNESS_M / 2, 0.0, -PAD_HEIGHT_M / 2])
"""Centre of the left pad box in ``hande_left``; half extents are ``PAD_HALF_EXTENTS_M``."""
T_TCP_RIGHT_PAD: Array = transform(t=[-PAD_THICKNESS_M / 2, 0.0, -PAD_HEIGHT_M / 2])
"""Centre of the right pad box in ``hande_right``."""
PAD_HALF_EXTENTS_M = (PAD_THICKNESS_M / 2, PAD_WIDTH_M / 2, PAD_HEIGHT_M / 2)
FINGER_RANGE_M = (0.0, STROKE_M / 2)
"""Range of each finger's slide joint: 0 closed, 25 mm fully open."""
HAND_MASS_KG = COUPLING_MASS_KG + BODY_MASS_KG + 2 * (CARRIAGE_MASS_KG + FINGER_MASS_KG)

RACK_WIDTH_M = 0.025
RACK_DEPTH_M = 0.0085
"""The slider under a carriage, in the body's groove."""
NECK_STEPS = 3
"""Boxes that enclose the taper between the blade and the carriage."""


def _finger_collision(side: str, sign: float) -> list[Primitive]:
    """Rack, carriage, neck and blade of one finger; ``sign`` is the side of the pad plane on which it lies."""
    body = f"hande_{side}"
    root, top = -FINGER_LENGTH_M, -FINGER_LENGTH_M - CARRIAGE_HEIGHT_M

    def solid(
        name: str, x: tuple[float, float], width: float, z: tuple[float, float], *, pad: bool = False
    ) -> Primitive:
        low, high = (sign * x[0], -width / 2, z[0]), (sign * x[1], width / 2, z[1])
        return box_between(name, body, low, high, touches=pad)

    steps = np.linspace(0.0, 1.0, NECK_STEPS + 1)
    heights = -PAD_HEIGHT_M + (root + PAD_HEIGHT_M) * steps
    thicknesses = PAD_THICKNESS_M + (FINGER_ROOT_THICKNESS_M - PAD_THICKNESS_M) * steps
    widths = PAD_WIDTH_M + (FINGER_ROOT_WIDTH_M - PAD_WIDTH_M) * steps
    neck = [
        solid(f"hand_{side}_neck_{i}", (PAD_COATING_M, thicknesses[i + 1]), widths[i + 1], (heights[i + 1], heights[i]))
        for i in range(NECK_STEPS)
    ]
    return [
        solid(f"pad_{side}", (0.0, PAD_THICKNESS_M), PAD_WIDTH_M, (-PAD_HEIGHT_M, 0.0), pad=True),
        *neck,
        solid(f"hand_{side}_carriage", (CARRIAGE_GAP_M, CARRIAGE_LENGTH_M), CARRIAGE_WIDTH_M, (top, root)),
        solid(f"hand_{side}_rack", (CARRIAGE_GAP_M, CARRIAGE_LENGTH_M), RACK_WIDTH_M, (top - RACK_DEPTH_M, top)),
    ]


COLLISION = (
    cylinder_between(
        "hand_body", "hande_base", (0, 0, 0), (0, 0, COUPLING_HEIGHT_M + BODY_HEIGHT_M), BODY_RADIUS_M + 0.0003
    ),
    box_between("hand_plug", "hande_base", (-0.0092, 0.030, 0.001), (0.0092, 0.0427, 0.0092)),
    *_finger_collision("left", 1.0),
    *_finger_collision("right", -1.0),
)
"""Solids that enclose coupling, body and fingers; ``pad_left`` and ``pad_right`` are the blades exactly."""


def opening_from_counts(counts: float) -> float:
    """Opening between the pads in metres at a register position 0 (open) .. 255 (closed), linear."""
    return STROKE_M * (1.0 - counts / COUNTS)


def counts_from_opening(opening_m: float) -> int:
    """Register position 0 (open) .. 255 (closed) nearest to an opening between the pads in metres."""
    return round(COUNTS * min(max(1.0 - opening_m / STROKE_M, 0.0), 1.0))
