"""Builds the folders of the three USB Type-C parts: ``python -m cad.models.build [library]`` (extra ``cad``).

Mesh, convex pieces, symmetries and keypoints are written. Where they changed, these must follow for each part, in this
order: ``tagcell part stable-poses NAME --drops 5000 --write`` (stable poses and grasps), ``python -m
scenes.part_preview NAME`` (contact sheet), and training, for weights go by the parts they were made for.
"""

from __future__ import annotations

import sys
from datetime import datetime
from pathlib import Path

import numpy as np
import trimesh
from build123d import Solid, export_step  # pyright: ignore[reportMissingImports]

from cad.collision import cut_shapes
from cad.folders import PartFacts, write_part_folder
from cad.meshes import ANGULAR_DEFLECTION_RAD, DEFLECTION_MM, mesh_from_triangles
from cad.models import usb_c
from cad.models.usb_c_pieces import pieces
from cad.parts import LIBRARY

_STEEL = "stainless steel SUS304, 7.9 g/cm3"
_EPOCH = datetime(2025, 1, 1)  # the date in the STEP header, fixed so that the same script gives the same file
FACTS = {
    "inserted": PartFacts(
        name="inserted",
        obj_id=1,
        density_kg_m3=1600.0,
        material="liquid crystal polymer, glass filled, 1.6 g/cm3",
        rgba=(0.20, 0.20, 0.21, 1.0),  # black LCP reflects 3-4 %; colours here are sRGB-encoded, as cameras deliver
        metallic=0.0,
        roughness=0.55,
        sources=(usb_c.SPEC, usb_c.DRAWING),
    ),
    "main": PartFacts(
        name="main",
        obj_id=2,
        density_kg_m3=7900.0,
        material=_STEEL,
        rgba=(0.74, 0.74, 0.76, 1.0),
        metallic=1.0,
        roughness=0.3,
        sources=(usb_c.SPEC, usb_c.DRAWING),
    ),
    "top": PartFacts(
        name="top",
        obj_id=3,
        density_kg_m3=7900.0,
        material=_STEEL,
        rgba=(0.78, 0.78, 0.79, 1.0),
        metallic=1.0,
        roughness=0.35,
        sources=(usb_c.DRAWING,),
    ),
}


def triangulate(solid: Solid) -> trimesh.Trimesh:
    """A checked mesh in metres of a solid in millimetres."""
    vertices, triangles = solid.tessellate(DEFLECTION_MM, ANGULAR_DEFLECTION_RAD)
    return mesh_from_triangles(1e-3 * np.array([[v.X, v.Y, v.Z] for v in vertices]), triangles)


def build_part(name: str, library: Path) -> None:
    """Make one part and write its folder ``library/name``, without stable poses and grasps."""
    features = usb_c.FEATURES[name]()
    in_mm = np.diag([1e3, 1e3, 1e3, 1.0])
    meshes = {key: [triangulate(s).apply_transform(in_mm) for s in group] for key, group in features.items()}
    hulls = [hull.apply_scale(1e-3) for hull in pieces(name, meshes)]
    solid = usb_c.fuse(features)
    mesh = triangulate(solid)
    write_part_folder(library / name, mesh, cut_shapes(mesh, hulls), FACTS[name])
    export_step(solid, library / name / "source.step", timestamp=_EPOCH)


def main() -> None:
    """Build every part into the library named on the command line, by default the package's own."""
    library = Path(sys.argv[1]) if len(sys.argv) > 1 else LIBRARY
    for name in usb_c.FEATURES:
        build_part(name, library)
        print(f"{library / name}")


if __name__ == "__main__":
    main()
