"""Camera, stand, tray and table as solids, in millimetres, in the frames of ``cad.station``, which holds the sizes."""

from __future__ import annotations

from build123d import (  # pyright: ignore[reportMissingImports]
    Axis,
    Box,
    Plane,
    Polyline,
    Pos,
    Rot,
    Shape,
    chamfer,
    extrude,
    make_face,
)

from cad import station
from cad.models.solids import Finish, Piece, barrel, box, fuse

ANODISED = Finish(rgba=(0.72, 0.73, 0.75, 1.0), metallic=0.8, roughness=0.4)
BLACK = Finish(rgba=(0.07, 0.07, 0.08, 1.0), metallic=0.2, roughness=0.5)
CAMERA_GREY = Finish(rgba=(0.55, 0.57, 0.60, 1.0), metallic=0.5, roughness=0.4)
GLASS = Finish(rgba=(0.10, 0.12, 0.20, 1.0), metallic=0.0, roughness=0.1)
TRAY_BLUE = Finish(rgba=(0.16, 0.21, 0.27, 1.0), metallic=0.0, roughness=0.7)
LINE = Finish(rgba=(0.85, 0.86, 0.88, 1.0), metallic=0.0, roughness=0.7)
TABLE_GREY = Finish(rgba=(0.52, 0.53, 0.54, 1.0), metallic=0.0, roughness=0.6)

FRONT, MOUNT, CAMERA_FRONT, CAMERA_BACK = (
    1e3 * v for v in (station.LENS_FRONT_Z_M, station.MOUNT_Z_M, station.CAMERA_FRONT_Z_M, station.CAMERA_BACK_Z_M)
)
LENS_RADIUS, CAMERA_HALF = 1e3 * station.LENS_RADIUS_M, 500 * station.CAMERA_WIDTH_M
CONNECTOR_BACK = CAMERA_FRONT + 1e3 * (station.MOUNT_LENGTH_M - station.CAMERA_LENGTH_WITH_MOUNT_M)
HALF_PROFILE, COLUMN, BOOM_Z = 500 * station.PROFILE_M, 1e3 * station.COLUMN_HEIGHT_M, 1e3 * station.BOOM_Z_M
REACH, OVERHANG = 1e3 * station.BOOM_REACH_M, 1e3 * station.BOOM_OVERHANG_M
SLOT_MOUTH, SLOT_DEPTH = 4.0, 7.0
"""Half the width, and the depth, of the profile's grooves."""
OUTLINE_WIDTH, OUTLINE_HEIGHT = 0.5, 0.05
LEG = 60.0


def station_pieces() -> list[Piece]:
    """Every solid that stands still."""
    return [*_camera(), *_stand(), *_tray(), *_table()]


def nest_outline() -> Piece:
    """The square drawn round a nest; its frame is the nest's, its lines lie on the surface."""
    side = 1e3 * station.NEST_OUTLINE_M
    lines = Box(side, side, OUTLINE_HEIGHT) - Box(side - 2 * OUTLINE_WIDTH, side - 2 * OUTLINE_WIDTH, 1)
    return Piece(name="tray_nest", body="nest", shape=Pos(0, 0, OUTLINE_HEIGHT / 2) * lines, finish=LINE)


def _camera() -> list[Piece]:
    square = (-CAMERA_HALF, CAMERA_HALF)
    case = box(square, square, (CAMERA_BACK, CAMERA_FRONT), rounding=1.5)
    mount = barrel(14.2, CAMERA_FRONT, MOUNT)
    connectors = fuse(
        [
            box((-7, 7), (-9, -1), (CONNECTOR_BACK, CAMERA_BACK), rounding=1),
            Pos(0, 7, 0) * barrel(4.5, CONNECTOR_BACK + 1, CAMERA_BACK),
        ]
    )
    rear = barrel(LENS_RADIUS - 2, MOUNT, MOUNT + 8)
    tube = barrel(LENS_RADIUS, MOUNT + 8, FRONT, round_low=1, round_high=0.5) - barrel(LENS_RADIUS - 4, FRONT - 5, 1)
    for z in (MOUNT + 13, MOUNT + 22):
        tube -= barrel(30, z, z + 2) - barrel(LENS_RADIUS - 1, z - 1, z + 3)
    screw = Pos(LENS_RADIUS - 1, 0, MOUNT + 18.5) * Rot(0, 90, 0) * barrel(1.4, 0, 1)
    parts = (
        ("case", case, CAMERA_GREY),
        ("mount", mount, ANODISED),
        ("connectors", connectors, BLACK),
        ("lens", fuse([rear, tube, screw]), BLACK),
        ("glass", barrel(LENS_RADIUS - 4, FRONT - 6, FRONT - 4.5), GLASS),
    )
    return [Piece(name=f"camera_{n}", body="camera_body", shape=s, finish=f) for n, s, f in parts]


def _profile(length: float) -> Shape:
    """A profile with one groove a side, along z from 0."""
    a, mouth, depth = HALF_PROFILE, SLOT_MOUTH, SLOT_DEPTH
    side = [(a, -a + 1.5), (a, -mouth), (a - depth, -mouth), (a - depth, mouth), (a, mouth), (a, a - 1.5)]
    outline = []
    for _ in range(4):
        outline += side
        side = [(-y, x) for x, y in side]
    return extrude(make_face(Polyline(*outline, close=True)), length)


def _stand() -> list[Piece]:
    foot = 500 * station.FOOT_WIDTH_M
    column = Pos(0, 0, 1e3 * station.FOOT_HEIGHT_M) * _profile(COLUMN - 1e3 * station.FOOT_HEIGHT_M)
    boom = Pos(-HALF_PROFILE, 0, BOOM_Z) * Rot(0, -90, 0) * _profile(REACH + OVERHANG - HALF_PROFILE)
    near = -REACH + CAMERA_HALF + 1e3 * station.BRACKET_GAP_M
    far = near + 1e3 * station.BRACKET_THICKNESS_M
    half = 500 * station.BRACKET_WIDTH_M
    bracket = box((near, far), (-half, half), (1e3 * station.BRACKET_LOW_Z_M, BOOM_Z - HALF_PROFILE))
    corner, leg = (-HALF_PROFILE, BOOM_Z - HALF_PROFILE), 1e3 * station.GUSSET_M
    triangle = Polyline(corner, (corner[0], corner[1] - leg), (corner[0] - leg, corner[1]), close=True)
    parts = (
        ("foot", box((-foot, foot), (-foot, foot), (0, 1e3 * station.FOOT_HEIGHT_M), rounding=8), BLACK),
        ("column", column, ANODISED),
        ("boom", boom, ANODISED),
        ("bracket", bracket, BLACK),
        ("gusset", extrude(Plane.XZ * make_face(triangle), 8, both=True), BLACK),
    )
    return [Piece(name=f"stand_{n}", body="stand", shape=s, finish=f) for n, s, f in parts]


def _tray() -> list[Piece]:
    x, y, z = (1e3 * v for v in station.TRAY_SIZE_M)
    plate = box((-x / 2, x / 2), (-y / 2, y / 2), (-z, 0), rounding=5)
    plate = chamfer(plate.faces().sort_by(Axis.Z)[-1].edges(), 0.8)
    return [Piece(name="tray_plate", body="tray", shape=plate, finish=TRAY_BLUE)]


def _table() -> list[Piece]:
    x, y = ((1e3 * low, 1e3 * high) for low, high in (station.TABLE_X_M, station.TABLE_Y_M))
    thickness, height = 1e3 * station.TABLE_THICKNESS_M, 1e3 * station.TABLE_HEIGHT_M
    top = box(x, y, (-thickness, 0), rounding=10)
    corners = [(cx, cy) for cx in (x[0] + 80, x[1] - 80) for cy in (y[0] + 80, y[1] - 80)]
    legs = [
        box((cx - LEG / 2, cx + LEG / 2), (cy - LEG / 2, cy + LEG / 2), (-height, -thickness), rounding=4)
        for cx, cy in corners
    ]
    parts = (("top", top, TABLE_GREY), ("legs", fuse(legs), ANODISED))
    return [Piece(name=f"table_{n}", body="table", shape=s, finish=f) for n, s, f in parts]
