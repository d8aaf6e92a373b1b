"""Builds every mesh of the cell (arm, hand, camera, stand, tray, table) into ``cad/library/cell``.

Run ``python -m cad.models.cell`` with the extra ``cad`` installed. ``meshes.json`` lists file, body and finish of each
mesh, so that a scene loads them in a loop; ``cell.step`` holds the same solids in the bodies' own frames.
"""

from __future__ import annotations

from cad.models.hande import hande_pieces
from cad.models.solids import write_pieces
from cad.models.station import nest_outline, station_pieces
from cad.models.ur5e import ur5e_pieces
from cad.parts import LIBRARY

FOLDER = LIBRARY / "cell"


def main() -> None:
    """Build everything and print the size."""
    triangles = write_pieces([*ur5e_pieces(), *hande_pieces(), *station_pieces()], [nest_outline()], FOLDER)
    print(f"{triangles} triangles, {sum(f.stat().st_size for f in FOLDER.iterdir()) / 1e6:.2f} MB in {FOLDER}")


if __name__ == "__main__":
    main()
