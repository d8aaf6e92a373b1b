"""What stands still in the cell: camera with its lens, stand, tray and table. Dimensions and collision solids.

Body frames. ``camera_body``: OpenCV's camera frame, origin at the optical centre, +z towards the scene. ``stand``:
world axes, origin at the foot of the column on the table. ``tray``: origin at the centre of the top face, +z up.
``table``: world axes, origin at the robot's base on the table's top face.
"""

from __future__ import annotations

from cad.primitives import Primitive, box_between

# Basler ace U with USB 3.0 (acA5472-17uc), product documentation: C-mount, 29.3 x 29 x 29 mm without lens mount and
# connectors, 48.2 x 29 x 29 mm with them.
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
BRACKET_GAP_M = 0.0025
BRACKET_THICKNESS_M = 0.006
BRACKET_WIDTH_M = 0.030
BRACKET_LOW_Z_M = 0.752
GUSSET_M = 0.070
"""Legs of the triangle that stiffens the corner of column and boom."""
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


def _collision() -> tuple[Primitive, ...]:
    half, foot, bracket = PROFILE_M / 2, FOOT_WIDTH_M / 2, BRACKET_WIDTH_M / 2
    near = -BOOM_REACH_M + CAMERA_WIDTH_M / 2 + BRACKET_GAP_M
    far = near + BRACKET_THICKNESS_M
    boom_low, boom_high = BOOM_Z_M - half, BOOM_Z_M + half
    tip = -BOOM_REACH_M - BOOM_OVERHANG_M
    back = CAMERA_FRONT_Z_M + MOUNT_LENGTH_M - CAMERA_LENGTH_WITH_MOUNT_M
    tray_x, tray_y, tray_z = TRAY_SIZE_M
    return (
        box_between("stand_foot", "stand", (-foot, -foot, 0.0), (foot, foot, FOOT_HEIGHT_M)),
        box_between("stand_column", "stand", (-half, -half, 0.0), (half, half, COLUMN_HEIGHT_M)),
        box_between("stand_boom", "stand", (tip, -half, boom_low), (half, half, boom_high)),
        box_between("stand_bracket", "stand", (near, -bracket, BRACKET_LOW_Z_M), (far, bracket, boom_low)),
        box_between("stand_gusset", "stand", (-GUSSET_M - half, -0.008, boom_low - GUSSET_M), (-half, 0.008, boom_low)),
        box_between(
            "stand_camera",
            "camera_body",
            (-LENS_RADIUS_M, -LENS_RADIUS_M, back),
            (LENS_RADIUS_M, LENS_RADIUS_M, LENS_FRONT_Z_M),
        ),
        box_between("tray", "tray", (-tray_x / 2, -tray_y / 2, -tray_z), (tray_x / 2, tray_y / 2, 0.0)),
    )


COLLISION = _collision()
"""Solids that enclose camera, stand and tray, each in its body's frame; the table is a plane or box of the scene's."""
