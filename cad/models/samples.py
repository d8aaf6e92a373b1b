"""Sample parts for ``tagcell part add``: STEP files as manufacturers publish them, ``python -m cad.models.samples``.

In millimetres. A socket head screw (axis z, head up, origin under the head) and a hex nut (axis z, origin in the
middle) from their standards, a pin header of several touching solids, and a bent bracket without any symmetry.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

from build123d import (  # pyright: ignore[reportMissingImports]
    Axis,
    Compound,
    Cylinder,
    Face,
    GeomType,
    Part,
    Plane,
    Polyline,
    Pos,
    RegularPolygon,
    Shape,
    SlotOverall,
    chamfer,
    export_step,
    extrude,
    fillet,
    make_face,
    revolve,
)

from cad.models.solids import STEP_DATE, box

SCREW_SOURCE = "ISO 4762 (socket head cap screws), M2: head 3.8 x 2, hexagon socket 1.5 x 1, fillet 0.1, edge 0.2"
NUT_SOURCE = "ISO 4032 (hexagon regular nuts, style 1), M2: 4.0 across flats, height 1.6, countersink 2.3 at most"
HEADER_SOURCE = (
    "Published drawings of single-row pin headers of pitch 2.54 mm (Wurth Elektronik WR-PHD 61300411121 and alike): "
    "body 10.16 x 2.54 x 2.54 mm, pins 0.64 mm square reaching 6.0 mm above and 3.0 mm below the body"
)
BRACKET_SOURCE = "Own design; inner bend radius of one sheet thickness, as DIN 6935 allows for steel of 0.5 mm"

SCREW_DIAMETER, SCREW_LENGTH = 2.0, 6.0  # SCREW_SOURCE down to SOCKET_DEPTH
HEAD_DIAMETER, HEAD_HEIGHT, HEAD_EDGE, HEAD_FILLET = 3.8, 2.0, 0.2, 0.1
SOCKET_FLATS, SOCKET_DEPTH = 1.5, 1.0
TIP_CHAMFER = 0.3

NUT_FLATS, NUT_HEIGHT, NUT_COUNTERSINK = 4.0, 1.6, 2.2  # NUT_SOURCE
NUT_HOLE = 1.6  # the minor diameter of an M2 thread, 1.567, rounded; the thread is not modelled
NUT_FACE, NUT_EDGE_DEG = 3.6, 30.0  # diameter of the bearing face and the angle of the chamfer around it

PINS, PITCH, PIN_WIDTH = 4, 2.54, 0.64  # HEADER_SOURCE
PIN_ABOVE, PIN_BELOW, PIN_TIP = 6.0, 3.0, 0.15
BODY_SIZE, BODY_NOTCH = 2.54, 0.45

SHEET, BEND = 0.5, 0.5  # BRACKET_SOURCE
PLATE_LENGTH, PLATE_WIDTH, FLANGE_HEIGHT = 8.0, 6.0, 5.0
FLANGE_START, PLATE_CORNER = 2.5, 2.0  # where the flange begins along the plate; cut-off corner
ROUND_HOLE, SLOT_LENGTH, SLOT_WIDTH = 2.2, 2.4, 1.2


def screw() -> Part:
    """Socket head screw M2 x 6 without its thread; total length 8 mm."""
    radius, head = SCREW_DIAMETER / 2, HEAD_DIAMETER / 2
    solid = _turned(
        [
            (0, -SCREW_LENGTH),
            (radius - TIP_CHAMFER, -SCREW_LENGTH),
            (radius, -SCREW_LENGTH + TIP_CHAMFER),
            (radius, 0),
            (head, 0),
            (head, HEAD_HEIGHT - HEAD_EDGE),
            (head - HEAD_EDGE, HEAD_HEIGHT),
            (0, HEAD_HEIGHT),
        ]
    )
    rims = solid.edges().filter_by(GeomType.CIRCLE)
    neck = min(rims, key=lambda rim: (abs(rim.center().Z), rim.radius))
    solid = fillet(neck, HEAD_FILLET)
    hexagon = RegularPolygon(SOCKET_FLATS / 2, 6, major_radius=False)
    return solid - Pos(0, 0, HEAD_HEIGHT) * extrude(hexagon, amount=-SOCKET_DEPTH)


def nut() -> Part:
    """Hex nut M2, chamfered on both faces, with a countersunk plain hole."""
    half, face, reach = NUT_HEIGHT / 2, NUT_FACE / 2, NUT_FLATS
    rise = (reach - face) * math.tan(math.radians(NUT_EDGE_DEG))
    hole, mouth = NUT_HOLE / 2, NUT_COUNTERSINK / 2
    prism = Pos(0, 0, -half) * extrude(RegularPolygon(NUT_FLATS / 2, 6, major_radius=False), amount=NUT_HEIGHT)
    bevel = _turned([(0, -half), (face, -half), (reach, rise - half), (reach, half - rise), (face, half), (0, half)])
    depth = mouth - hole  # 90 degrees
    bore = _turned([(0, -half), (mouth, -half), (hole, depth - half), (hole, half - depth), (mouth, half), (0, half)])
    return (prism & bevel) - bore


def header() -> Compound:
    """Pin header 1 x 4: the plastic body and four pins as five solids that touch."""
    length, half = PINS * PITCH, BODY_SIZE / 2
    centres = [(i - (PINS - 1) / 2) * PITCH for i in range(PINS)]
    body = box((-length / 2, length / 2), (-half, half), (0, BODY_SIZE))
    notch = extrude(RegularPolygon(BODY_NOTCH, 4), amount=3 * BODY_SIZE)
    for x in (i * PITCH - length / 2 for i in range(PINS + 1)):
        for y in (-half, half):
            body -= Pos(x, y, -BODY_SIZE) * notch
    pins = []
    for x in centres:
        across, wide = PIN_WIDTH / 2, (x - PIN_WIDTH / 2, x + PIN_WIDTH / 2)
        pin = box(wide, (-across, across), (-PIN_BELOW, BODY_SIZE + PIN_ABOVE))
        body -= pin
        tips = pin.faces().sort_by(Axis.Z)
        pins.append(chamfer([*tips[0].edges(), *tips[-1].edges()], PIN_TIP))
    solids = {"body": body} | {f"pin_{i + 1}": pin for i, pin in enumerate(pins)}
    for label, solid in solids.items():
        solid.label = label
    return Compound(children=list(solids.values()))


def bracket() -> Part:
    """Sheet of 0.5 mm: a plate of 8 x 6 mm with a flange 5 mm high along part of one side, two holes, a cut corner."""
    inner, outer = BEND, BEND + SHEET
    plate = box((0, PLATE_LENGTH), (outer, PLATE_WIDTH), (0, SHEET))
    corner = _polygon([(0, PLATE_WIDTH), (PLATE_CORNER, PLATE_WIDTH), (0, PLATE_WIDTH - PLATE_CORNER)])
    plate -= Pos(0, 0, -SHEET) * extrude(corner, amount=3 * SHEET)
    flange = box((FLANGE_START, PLATE_LENGTH), (0, SHEET), (outer, FLANGE_HEIGHT))
    middle = (FLANGE_START + PLATE_LENGTH) / 2
    ring = Cylinder(outer, PLATE_LENGTH - FLANGE_START) - Cylinder(inner, PLATE_LENGTH - FLANGE_START)
    ring = Pos(middle, outer, outer) * (Plane.YZ * ring)
    bend = ring & box((FLANGE_START, PLATE_LENGTH), (0, outer), (0, outer))
    solid = plate + bend + flange
    solid -= Pos(2.2, 2.7, 0) * Cylinder(ROUND_HOLE / 2, 4 * SHEET)
    slot = Plane.XZ * extrude(SlotOverall(SLOT_LENGTH, SLOT_WIDTH), amount=2 * SHEET, both=True)
    return solid - Pos(6.0, 0, 3.2) * slot


def _polygon(corners: Sequence[tuple[float, float]]) -> Face:
    return make_face(Polyline(*corners, close=True))


def _turned(corners: Sequence[tuple[float, float]]) -> Part:
    """Solid of revolution about z from the corners (radius, z) of half its section."""
    return revolve(Plane.XZ * _polygon(corners), Axis.Z)


SAMPLES = {"m2_screw": screw, "hex_nut": nut, "pin_header": header, "bracket": bracket}
"""Makers of the samples, by the name of the file."""


def main() -> None:
    """Write every sample as STEP into the folder named on the command line, by default ``examples/parts``."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[2] / "examples" / "parts"
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in SAMPLES.items():
        shape: Shape = make()
        shape.label = name
        export_step(shape, folder / f"{name}.step", write_pcurves=False, timestamp=STEP_DATE)
        print(f"{folder / name}.step: {len(shape.solids())} solids, {shape.volume:.3f} mm3")


if __name__ == "__main__":
    main()
