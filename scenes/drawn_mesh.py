"""The triangles of a compiled model's geoms, with normals and texture coordinates, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.look import SMOOTH_ANGLE

SECTIONS = 64
"""Facets round a sphere, cylinder or capsule."""
_GEOM = mujoco.mjtGeom


@dataclass(frozen=True, kw_only=True)
class DrawnMesh:
    """Triangles in the geom's frame, metres: vertices (V, 3), normals (V, 3), faces (F, 3) anticlockwise from outside.

    Vertices are repeated where normals or texture coordinates differ. ``texcoords`` (V, 2), (0, 0) at the top left of
    the image and not yet repeated; None where the mesh has none.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.int32]
    texcoords: NDArray[np.float32] | None = None


def mesh_key(model: mujoco.MjModel, i: int) -> tuple[float, ...]:
    """Equal for geoms of one mesh."""
    kind = int(model.geom_type[i])
    if kind == _GEOM.mjGEOM_MESH:
        return (kind, int(model.geom_dataid[i]))
    return (kind, *(float(x) for x in model.geom_size[i]))


def mesh_of_geom(model: mujoco.MjModel, i: int) -> DrawnMesh:
    """What geom ``i`` looks like; raises SceneError for a type of geom that is not drawn."""
    if model.geom_type[i] == _GEOM.mjGEOM_MESH:
        return _asset(model, int(model.geom_dataid[i]))
    solid = _primitive(model, i)
    solid.merge_vertices()
    drawn = trimesh.graph.smooth_shade(solid, angle=SMOOTH_ANGLE)
    return DrawnMesh(
        vertices=np.asarray(drawn.vertices, np.float32),
        normals=np.asarray(drawn.vertex_normals, np.float32),
        faces=np.asarray(drawn.faces, np.int32),
    )


def _asset(model: mujoco.MjModel, k: int) -> DrawnMesh:
    """A mesh asset. MuJoCo indexes positions, normals and texture coordinates apart; here a corner is one vertex."""

    def rows(name: str) -> NDArray[np.float32]:
        start, count = getattr(model, f"mesh_{name}adr")[k], getattr(model, f"mesh_{name}num")[k]
        return np.array(getattr(model, f"mesh_{name}")[start : start + count], np.float32)

    faces = slice(model.mesh_faceadr[k], model.mesh_faceadr[k] + model.mesh_facenum[k])
    textured = model.mesh_texcoordnum[k] > 0
    corners = [model.mesh_face[faces], model.mesh_facenormal[faces]]
    if textured:
        corners.append(model.mesh_facetexcoord[faces])
    unique, index = np.unique(np.stack(corners, axis=-1).reshape(-1, len(corners)), axis=0, return_inverse=True)
    return DrawnMesh(
        vertices=rows("vert")[unique[:, 0]],
        normals=rows("normal")[unique[:, 1]],
        faces=index.reshape(-1, 3).astype(np.int32),
        texcoords=rows("texcoord")[unique[:, 2]] if textured else None,
    )


def _primitive(model: mujoco.MjModel, i: int) -> trimesh.Trimesh:
    """A geom without a mesh of its own, in its own frame; an endless plane reaches as far as the camera sees."""
    kind, size = mujoco.mjtGeom(model.geom_type[i]), model.geom_size[i]
    if kind == _GEOM.mjGEOM_PLANE:
        far = model.vis.map.zfar * model.stat.extent
        x, y = (half if half > 0 else far for half in size[:2])
        corners = [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]
        return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    if kind == _GEOM.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind == _GEOM.mjGEOM_SPHERE:
        return trimesh.creation.uv_sphere(radius=size[0], count=[SECTIONS // 2, SECTIONS])
    if kind == _GEOM.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=SECTIONS)
    if kind == _GEOM.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=[SECTIONS, SECTIONS])
    drawn = "mesh, plane, box, sphere, cylinder, capsule"
    raise SceneError(f"geom {model.geom(i).name!r} is a {kind.name}; only {drawn} are drawn")
