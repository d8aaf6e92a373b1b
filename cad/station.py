"""What stands still in the cell: camera with its lens, stand, tray and table. Dimensions and collision solids.

Body frames. ``camera_body``: OpenCV's camera frame, origin at the optical centre, +z towards the scene. ``stand``: world
axes, origin at the foot of the column on the table. ``tray``: origin at the centre of the top face, +z up. ``table``:
world axes, origin at the robot's base on the table's top face.
"""

from __future__ import annotations

from cad.primitives import Primitive
from cad.spatial import Array, rotation_y, transform

# Basler acA5472-17uc, product page: 29.3 x 29 x 29 mm without lens mount and connectors, 48.2 mm long with them, C-mount.
CAMERA_WIDTH_M = 0.029
CAMERA_LENGTH_M = 0.0293
CAMERA_LENGTH_WITH_MOUNT_M = 0.0482
MOUNT_LENGTH_M = 0.006
LENS_RADIUS_M = 0.0165
LENS_LENGTH_M = 0.036
LENS_FRONT_Z_M = -0.001
"""The lens's front rim, just behind the optical centre so that it never hides the scene from a pinhole camera. In the
real lens the entrance pupil, which the optical centre stands for, lies a little behind the front glass."""
MOUNT_Z_M = LENS_FRONT_Z_M - LENS_LENGTH_M
CAMERA_FRONT_Z_M = MOUNT_Z_M - MOUNT_LENGTH_M
CAMERA_BACK_Z_M = CAMERA_FRONT_Z_M - CAMERA_LENGTH_M

# Stand: ours. A 40 mm aluminium profile column with a boom that reaches over the board.
PROFILE_M = 0.040
COLUMN_HEIGHT_M = 0.860
BOOM_Z_M = 0.830
"""Height of the boom's axis: the boom lies above the camera, outside its view."""
BOOM_REACH_M = 0.400
"""From the column's axis to the camera's axis, along -x."""
BOOM_OVERHANG_M = 0.030
"""The boom goes on past the camera's axis by this much."""
BRACKET_GAP_M = 0.0005
BRACKET_THICKNESS_M = 0.006
BRACKET_WIDTH_M = 0.030
BRACKET_LOW_Z_M = 0.752
FOOT_WIDTH_M = 0.140
FOOT_HEIGHT_M = 0.012

# Tray and table: ours.
TRAY_SIZE_M = (0.120, 0.160, 0.010)
"""Along x, y, z; flat on top, so that a nest is a place on it and nothing more."""
NEST_OUTLINE_M = 0.014
"""Side of the square drawn round a nest."""
TABLE_X_M = (-0.35, 1.05)
TABLE_Y_M = (-0.65, 0.65)
TABLE_THICKNESS_M = 0.030
TABLE_HEIGHT_M = 0.75


def _solid(name: str, body: str, kind: str, size: tuple[float, ...], centre: tuple[float, float, float]) -> Primitive:
    return Primitive(name=name, body=body, kind=kind, size=size, T_body_geom=transform(t=centre))


def _collision() -> tuple[Primitive, ...]:
    half = PROFILE_M / 2
    boom = (PROFILE_M / 2 + BOOM_REACH_M + BOOM_OVERHANG_M) / 2
    bracket_x = -BOOM_REACH_M + CAMERA_WIDTH_M / 2 + BRACKET_GAP_M + BRACKET_THICKNESS_M / 2
    bracket_top = BOOM_Z_M - half
    camera_half = (LENS_FRONT_Z_M - (CAMERA_FRONT_Z_M + MOUNT_LENGTH_M - CAMERA_LENGTH_WITH_MOUNT_M)) / 2
    return (
        _solid("stand_column", "stand", "box", (half, half, COLUMN_HEIGHT_M / 2), (0.0, 0.0, COLUMN_HEIGHT_M / 2)),
        _solid("stand_foot", "stand", "box", (FOOT_WIDTH_M / 2, FOOT_WIDTH_M / 2, FOOT_HEIGHT_M / 2), (0.0, 0.0, 0.006)),
        _solid("stand_boom", "stand", "box", (boom, half, half), (half - boom, 0.0, BOOM_Z_M)),
        _solid(
            "stand_bracket",
            "stand",
            "box",
            (BRACKET_THICKNESS_M / 2, BRACKET_WIDTH_M / 2, (bracket_top - BRACKET_LOW_Z_M) / 2),
            (bracket_x, 0.0, (bracket_top + BRACKET_LOW_Z_M) / 2),
        ),
        _solid("stand_camera", "camera_body", "box", (0.0165, 0.0165, camera_half), (0.0, 0.0, LENS_FRONT_Z_M - camera_half)),
        _solid("tray", "tray", "box", tuple(v / 2 for v in TRAY_SIZE_M), (0.0, 0.0, -TRAY_SIZE_M[2] / 2)),
    )


COLLISION = _collision()
