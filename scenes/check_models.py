"""Checks the ``models`` folder of a BOP data set: sizes in millimetres, meshes, symmetries, keypoints."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from cad.parts import load_mesh
from cad.spatial import Array, diameter
from scenes.bop import PART_SIZE_M
from scenes.findings import Findings

DIAMETER_MM = (1e3 * PART_SIZE_M[0], 1e3 * PART_SIZE_M[1])
REMEDY = "write the models again, in millimetres"
SAME = 0.02
"""Share of the diameter that sizes told and measured may differ by."""
LARGEST = 1e12
_FIELDS = ("diameter", *(f"{kind}_{axis}" for kind in ("min", "size") for axis in "xyz"))


@dataclass(frozen=True, kw_only=True)
class Models:
    """What is known of the objects by their obj_id: diameters in mm, and files of meshes that can be read."""

    diameters: dict[int, float] = field(default_factory=dict)
    paths: dict[int, Path] = field(default_factory=dict)
    _meshes: dict[int, trimesh.Trimesh] = field(default_factory=dict)

    def mesh(self, obj_id: int) -> trimesh.Trimesh | None:
        """The mesh of an object, millimetres; None where there is none that can be read."""
        if obj_id not in self._meshes and obj_id in self.paths:
            self._meshes[obj_id] = load_mesh(self.paths[obj_id])
        return self._meshes.get(obj_id)


def check_models(folder: Path, findings: Findings) -> Models:
    """Check the models of the data set in ``folder`` and return those that can be used."""
    models, path = Models(), folder / "models" / "models_info.json"
    infos = findings.read_json(path, REMEDY)
    for name, info in (infos or {}).items():
        if not name.isdigit() or not isinstance(info, dict):
            findings.add(path, f"entry {name!r} is no obj_id with its facts", REMEDY)
            continue
        missing = [f for f in _FIELDS if not isinstance(info.get(f), int | float)]
        if missing:
            findings.add(path, f"object {name} lacks the numbers {', '.join(missing)}", REMEDY)
            continue
        obj_id = int(name)
        models.diameters[obj_id] = info["diameter"]
        if not DIAMETER_MM[0] <= info["diameter"] <= DIAMETER_MM[1]:
            findings.add(path, f"object {name} has diameter {info['diameter']:g} mm: {_unit(info['diameter'])}", REMEDY)
        _check_symmetries(path, name, info, findings)
        _check_mesh(folder / "models" / f"obj_{obj_id:06d}.ply", info, models, obj_id, findings)
    _check_keypoints(folder / "models" / "keypoints.json", infos or {}, models, findings)
    findings.counts["models"] = len(models.diameters)
    return models


def _unit(size_mm: float) -> str:
    return "it seems to be in metres" if size_mm < DIAMETER_MM[0] else "it seems to be in micrometres"


def _check_mesh(path: Path, info: dict[str, Any], models: Models, obj_id: int, findings: Findings) -> None:
    if not path.exists():
        findings.add(path, "is missing", REMEDY)
        return
    try:
        mesh = load_mesh(path)
    except Exception as error:  # trimesh's readers raise what they like at a broken file
        findings.add(path, f"cannot be read: {error}", REMEDY)
        return
    if not len(mesh.faces):
        findings.add(path, "has no triangles", REMEDY)
        return
    models.paths[obj_id] = path
    low, size = mesh.bounds[0], mesh.extents
    measured = np.array([diameter(mesh.convex_hull.vertices), *low, *size])
    told = np.array([info[f] for f in _FIELDS], np.float64)
    wrong = np.flatnonzero(np.abs(measured - told) > SAME * abs(info["diameter"]))
    if len(wrong):
        name, ratio = _FIELDS[wrong[0]], measured[0] / told[0]
        hint = f": the mesh is {ratio:.3g} times as large as told" if not 0.5 < ratio < 2 else ""
        findings.add(
            path, f"{name} is {measured[wrong[0]]:.4g}, not {told[wrong[0]]:.4g} as in models_info.json{hint}", REMEDY
        )


def _check_symmetries(path: Path, name: str, info: dict[str, Any], findings: Findings) -> None:
    remedy = "write each as 16 numbers row by row, or as axis and offset, in millimetres"
    low = np.array([info[f"min_{axis}"] for axis in "xyz"], np.float64)
    size = np.array([info[f"size_{axis}"] for axis in "xyz"], np.float64)
    for k, entry in enumerate(info.get("symmetries_discrete", [])):
        where = f"symmetries_discrete[{k}] of object {name}"
        T = numbers(entry, 16)
        if T is None:
            findings.add(path, f"{where} is not 16 numbers", remedy)
        elif not is_rigid(T.reshape(4, 4)):
            findings.add(path, f"{where} is no proper rotation and translation", remedy)
        else:
            centre = low + size / 2
            moved = float(np.linalg.norm(T.reshape(4, 4)[:3, :3] @ centre + T.reshape(4, 4)[:3, 3] - centre))
            if moved > 0.25 * info["diameter"]:
                findings.add(path, f"{where} moves the object by {moved:.3g} mm: the unit is wrong", remedy)
    for k, entry in enumerate(info.get("symmetries_continuous", [])):
        where = f"symmetries_continuous[{k}] of object {name}"
        axis, offset = (numbers(entry.get(key), 3) if isinstance(entry, dict) else None for key in ("axis", "offset"))
        if axis is None or offset is None:
            findings.add(path, f"{where} lacks axis or offset of 3 numbers each", remedy)
        elif abs(np.linalg.norm(axis) - 1) > 1e-3:
            findings.add(path, f"the axis of {where} is {np.linalg.norm(axis):g} long, not 1", remedy)
        elif ((offset < low - info["diameter"]) | (offset > low + size + info["diameter"])).any():
            findings.add(path, f"the offset of {where} is far from the object: the unit is wrong", remedy)


def _check_keypoints(path: Path, infos: dict[str, Any], models: Models, findings: Findings) -> None:
    """``keypoints.json`` is our own: where it is not there nothing is wrong."""
    content = findings.read_json(path, REMEDY) if path.exists() else {}
    for name, entry in (content or {}).items():
        listed = entry.get("keypoints") if isinstance(entry, dict) else None
        rows = [numbers(row, 3) for row in listed] if isinstance(listed, list) else [None]
        if name not in infos or any(row is None for row in rows):
            findings.add(path, f"entry {name!r} is no object of models_info.json with its keypoints (K, 3)", REMEDY)
            continue
        mesh = models.mesh(int(name))
        if mesh is None or not rows:
            continue
        points = np.array(rows, np.float64)
        beyond = np.maximum(mesh.bounds[0] - points, points - mesh.bounds[1]).max()
        reach, size = float(np.abs(points).max()), float(np.abs(mesh.bounds).max())
        if beyond > SAME * size or reach < 0.1 * size:
            findings.add(path, f"the keypoints of object {name} reach {reach:.3g} mm, it {size:.3g} mm", REMEDY)


def is_rigid(T: Array, tolerance: float = 1e-3) -> bool:
    """Whether (4, 4) or (3, 3) numbers are a proper rotation (and a translation)."""
    R = T[:3, :3]
    square = bool(np.abs(R @ R.T - np.eye(3)).max() < tolerance) and float(np.linalg.det(R)) > 0
    return square and (T.shape == (3, 3) or bool(np.allclose(T[3], [0, 0, 0, 1])))


def numbers(values: Any, count: int) -> Array | None:
    """``count`` finite numbers of a JSON list, below LARGEST, None when they are anything else."""
    good = isinstance(values, list) and len(values) == count and all(isinstance(v, int | float) for v in values)
    return np.array(values, np.float64) if good and all(abs(v) < LARGEST for v in values) else None
