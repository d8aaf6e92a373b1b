"""Parts on the terminal and as JSON: what their folders say."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cad.collision import read_collision
from cad.equivalence import symmetries_to_json
from cad.parts import Part
from twin.grasps import PoseGrasps, describe_grasps
from twin.robot import TwinError


def print_parts(parts: Sequence[Part], *, as_json: bool) -> None:
    """One line a part."""
    if as_json:
        print(json.dumps([describe_part(p) for p in parts], indent=1))
        return
    table = Table()
    for column in ("part", "obj_id", "size mm", "mass g", "material", "poses", "grasps"):
        left = column in ("part", "material")
        table.add_column(column, justify="left" if left else "right", no_wrap=column in ("part", "size mm"))
    for part in parts:
        size = " x ".join(f"{1e3 * s:.1f}" for s in part.mesh.extents)
        material = part.material.split(",")[0]
        row = (part.obj_id, size, f"{1e3 * part.mass_kg:.3g}", material)
        table.add_row(part.name, *map(str, row), str(len(part.stable_poses)), str(len(part.grasps)))
    Console().print(table)


def print_part(part: Part, *, as_json: bool) -> None:
    """Size, mass, symmetries, collision shapes, stable poses with their grasps, sources."""
    if as_json:
        print(json.dumps(describe_part(part), indent=1))
        return
    console = Console(highlight=False)
    print_parts([part], as_json=False)
    grasps = _grasps(part)
    table = Table(title="stable poses", title_justify="left")
    for column in ("face", "probability", "height mm", "up in the part frame", "looks like", "grasps"):
        table.add_column(column, justify="right")
    for pose in part.stable_poses:
        up = (np.round(pose.R_table_part[2], 3) + 0.0).tolist()
        alike = sorted({e.stable_pose for e in pose.view_equivalents or ()} - {pose.index})
        found = grasps[pose.index] if grasps else None
        table.add_row(
            str(pose.index),
            f"{pose.probability:.3f}",
            f"{1e3 * pose.height_m:.3f}",
            f"{up}{', any roll' if pose.roll is not None else ''}",
            ", ".join(map(str, alike)) or "-",
            str(len(found.grasps)) if found and found.grasps else "none",
        )
    console.print(table)
    for found in grasps or ():
        if not found.grasps:
            console.print(f"face {found.stable_pose} cannot be gripped: {found.why_not}")
    console.print(f"symmetries: {part.symmetries.describe()}")
    shapes = read_collision(part.folder)
    if shapes is not None:
        r = shapes.report
        pieces = f"{r.pieces} convex piece{'s' * (r.pieces > 1)} ({r.method})"
        console.print(
            f"collision shapes: {pieces}, at most {r.excess_max_um:.1f} um proud "
            f"({r.excess_mm3:.4f} mm3), {r.missing_max_um:.1f} um short ({r.missing_mm3:.4f} mm3)"
        )
    console.print(f"mesh {part.mesh_hash}; {part.folder}", soft_wrap=True)
    for source in part.sources:
        console.print(f"source: {source}", soft_wrap=True)


def describe_part(part: Part) -> dict[str, Any]:
    """What ``tagcell part show --json`` prints."""
    grasps = _grasps(part)
    shapes = read_collision(part.folder)
    return {
        "name": part.name,
        "obj_id": part.obj_id,
        "size_mm": [1e3 * float(s) for s in part.mesh.extents],
        "mass_kg": part.mass_kg,
        "material": part.material,
        "mesh_hash": part.mesh_hash,
        "symmetries": symmetries_to_json(part.symmetries),
        "collision": asdict(shapes.report) if shapes else None,
        "stable_poses": [
            {
                "index": p.index,
                "probability": p.probability,
                "height_m": p.height_m,
                "rolls": p.roll is not None,
                "view_class": p.view_class,
                "grasps": len(grasps[p.index].grasps) if grasps else 0,
                "why_not": "" if not grasps or grasps[p.index].grasps else grasps[p.index].why_not,
            }
            for p in part.stable_poses
        ],
        "grasps": len(part.grasps),
        "folder": str(part.folder),
    }


def _grasps(part: Part) -> tuple[PoseGrasps, ...] | None:
    """What is known of every pose's grasps; None where they were never planned for the part as it is."""
    try:
        return describe_grasps(part)
    except TwinError:
        return None
