"""Small things that are not parts: what else may lie on a board in a workshop."""

from __future__ import annotations

import numpy as np
import trimesh


def distractor_meshes() -> dict[str, trimesh.Trimesh]:
    """Name -> mesh in metres, lying on z = 0 round the origin; several of each of eleven kinds."""
    meshes: dict[str, trimesh.Trimesh] = {}
    for size in (2.0, 3.0, 4.0):
        meshes[f"washer_{size:.0f}"] = _washer(inner=size * 1.08, outer=size * 2.2, thickness=0.16 * size)
        meshes[f"nut_{size:.0f}"] = _nut(thread=size, width=1.85 * size, height=0.8 * size)
        meshes[f"screw_{size:.0f}"] = _screw(thread=size * 0.7, length=2.5 * size)
    for k, (x, y, z) in enumerate(((9, 7, 3), (5, 4, 2.5), (12, 3, 1.2), (7, 7, 0.5))):
        meshes[f"block_{k}"] = _block(x, y, z)
    for k, (radius, height) in enumerate(((3, 2), (1.6, 6), (4.5, 0.8))):
        meshes[f"disc_{k}"] = _lift(trimesh.creation.cylinder(radius=radius, height=height, sections=40))
    for k, (radius, length) in enumerate(((1.0, 8.0), (0.6, 12.0))):
        pin = trimesh.creation.cylinder(radius=radius, height=length, sections=24)
        meshes[f"pin_{k}"] = _lift(_turn(pin))
    for k, (width, length, height) in enumerate(((3, 14, 0.4), (6, 20, 0.2))):
        meshes[f"strip_{k}"] = _block(width, length, height)
    meshes["bracket_0"] = _folded(((7, 6, 0.5), (3.5, 0, 0.25)), ((0.5, 6, 4), (0.25, 0, 2)))
    floor, left, right = ((9, 7, 0.3), (0, 0, 0.15)), ((0.3, 7, 3), (-4.35, 0, 1.5)), ((0.3, 7, 3), (4.35, 0, 1.5))
    meshes["channel_0"] = _folded(floor, left, right)
    meshes["ball_0"] = _lift(trimesh.creation.icosphere(subdivisions=3, radius=1.75))
    for k, radius in enumerate((0.2, 0.35, 0.6, 0.9)):
        crumb = trimesh.creation.icosphere(subdivisions=1, radius=radius)
        crumb.apply_scale([1.0, 0.7, 0.4])
        meshes[f"crumb_{k}"] = _lift(crumb)
    for mesh in meshes.values():
        mesh.apply_scale(1e-3)
    return meshes


def _lift(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    centre = mesh.bounds.mean(axis=0)
    mesh.apply_translation([-centre[0], -centre[1], -mesh.bounds[0, 2]])
    return mesh


def _turn(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """From standing along z to lying along x."""
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    return mesh


def _block(x: float, y: float, z: float) -> trimesh.Trimesh:
    return _lift(trimesh.creation.box((x, y, z)))


def _washer(inner: float, outer: float, thickness: float) -> trimesh.Trimesh:
    return _lift(trimesh.creation.annulus(r_min=inner / 2, r_max=outer / 2, height=thickness, sections=40))


def _nut(thread: float, width: float, height: float) -> trimesh.Trimesh:
    return _lift(trimesh.creation.annulus(r_min=thread / 2, r_max=width / np.sqrt(3), height=height, sections=6))


def _screw(thread: float, length: float) -> trimesh.Trimesh:
    shank = trimesh.creation.cylinder(radius=thread / 2, height=length, sections=24)
    head = trimesh.creation.cylinder(radius=thread * 0.95, height=thread * 0.7, sections=32)
    head.apply_translation([0, 0, (length + thread * 0.7) / 2])
    return _lift(_turn(_join([shank, head])))


def _folded(*plates: tuple[tuple[float, float, float], tuple[float, float, float]]) -> trimesh.Trimesh:
    """Boxes (size, centre) joined to a bracket or a channel."""
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in plates]
    return _lift(_join(boxes))


def _join(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    joined = trimesh.util.concatenate(meshes)
    assert isinstance(joined, trimesh.Trimesh)
    return joined
