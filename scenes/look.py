"""Visual meshes, materials and the tagboard's face: how things look, shared by the cell and by training scenes.

The board is drawn as a plate (material ``board``) with the labels on it as printed stickers (material ``tags``), so the
background can be exchanged without touching the tags.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from cad.parts import Part
from cad.spatial import Array, quat_wxyz_from_rotation
from cad.tagboard import TagboardConfig, label_image
from scenes.gl import mujoco

STICKER_M = 5e-5
"""Depth of the drawn plate below the board's top face, so that labels, which lie in the face, are drawn on top."""
PIXELS_PER_CELL = 32
"""Resolution of the drawn labels: a power of two keeps cell borders on texel borders at every mipmap level."""
SMOOTH_ANGLE = np.radians(30.0)
"""Edges between faces that meet at a larger angle are drawn sharp."""
BACKGROUND_SIZE = 512
"""Pixels along each side of the board's background texture."""
MATT_SPECULAR, MATT_SHININESS = 0.05, 0.1


def add_mesh(spec: mujoco.MjSpec, name: str, mesh: trimesh.Trimesh) -> None:
    """Add a mesh asset with normals that are smooth over rounded faces and sharp at edges."""
    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    drawn = trimesh.graph.smooth_shade(welded, angle=SMOOTH_ANGLE)
    add_raw_mesh(spec, name, drawn.vertices, drawn.faces, normals=drawn.vertex_normals)


def add_raw_mesh(
    spec: mujoco.MjSpec,
    name: str,
    vertices: Array,
    faces: NDArray[np.integer],
    *,
    normals: Array | None = None,
    texcoords: Array | None = None,
) -> None:
    """Add a mesh asset as it is: vertices (V, 3), faces (F, 3), normals (V, 3) and texture coordinates (V, 2)."""
    spec.add_mesh(
        name=name,
        uservert=np.asarray(vertices, np.float32).ravel(),
        userface=np.asarray(faces, np.int32).ravel(),
        usernormal=() if normals is None else np.asarray(normals, np.float32).ravel(),
        usertexcoord=() if texcoords is None else np.asarray(texcoords, np.float32).ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL.value,
    )


def add_visual(
    body: mujoco.MjsBody,
    name: str,
    mesh: str,
    T_body_geom: Array | None = None,
    *,
    material: str = "",
    rgba: tuple[float, float, float, float] | None = None,
) -> mujoco.MjsGeom:
    """Add a mesh geom that is drawn, weighs nothing and touches nothing."""
    geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, material=material, mass=0.0)
    geom.contype = geom.conaffinity = 0
    geom.group = 1
    if T_body_geom is not None:
        geom.pos = T_body_geom[:3, 3]
        geom.quat = quat_wxyz_from_rotation(T_body_geom[:3, :3])
    if rgba is not None:
        geom.rgba = rgba
    return geom


def add_material(
    spec: mujoco.MjSpec,
    name: str,
    rgba: tuple[float, float, float, float],
    *,
    specular: float,
    shininess: float,
    texture: str = "",
    repeat: tuple[float, float] = (1.0, 1.0),
) -> None:
    """Add a material for the classic renderer, optionally with a colour texture repeated over the unit square."""
    material = spec.add_material(name=name, rgba=rgba, specular=specular, shininess=shininess, texrepeat=repeat)
    if texture:
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture


def add_texture(spec: mujoco.MjSpec, name: str, image: NDArray[np.uint8]) -> None:
    """Add a 2D colour texture (H, W, 3) uint8; texture coordinate (0, 0) is the top left of the image."""
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D)
    texture.height, texture.width, texture.nchannel = image.shape
    texture.data = np.ascontiguousarray(image).tobytes()


def add_part_material(spec: mujoco.MjSpec, name: str, part: Part) -> None:
    """Add the material of a part: specular metal or duller plastic, in the part's colour."""
    specular, shininess = classic_finish(part.metallic, part.roughness)
    add_material(spec, name, part.rgba, specular=specular, shininess=shininess)


def add_board_visuals(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, config: TagboardConfig, background: NDArray[np.uint8] | None = None
) -> None:
    """Draw the tagboard on ``body``, whose frame is ``board``.

    ``background`` (BACKGROUND_SIZE, BACKGROUND_SIZE, 3) uint8 is stretched over the plate; without it the plate is
    plain light grey. The plate casts no shadow: it could only fall on the plate itself, as noise.
    """
    if background is None:
        background = np.full((BACKGROUND_SIZE, BACKGROUND_SIZE, 3), 205, np.uint8)
    add_texture(spec, "board", background)
    add_material(spec, "board", (1.0, 1.0, 1.0, 1.0), texture="board", specular=MATT_SPECULAR, shininess=MATT_SHININESS)
    half = np.array([config.width_m / 2, config.height_m / 2])
    top, bottom = -STICKER_M, -config.thickness_m
    plate = trimesh.creation.box(bounds=[[-half[0], -half[1], bottom], [half[0], half[1], top]])
    plate.unmerge_vertices()
    texcoords = (plate.vertices[:, :2] * [1, -1] / half + 1) / 2
    normals = np.repeat(plate.face_normals, 3, axis=0)
    add_raw_mesh(spec, "board", plate.vertices, plate.faces, normals=normals, texcoords=texcoords)
    add_visual(body, "board_visual", "board", material="board").castshadow = False
    _add_labels(spec, body, config)


def _add_labels(spec: mujoco.MjSpec, body: mujoco.MjsBody, config: TagboardConfig) -> None:
    """All labels as one mesh of squares in the plane z = 0, textured from one atlas."""
    columns = int(np.ceil(np.sqrt(config.count)))
    rows = int(np.ceil(config.count / columns))
    labels = [label_image(i, PIXELS_PER_CELL) for i in config.ids]
    side = labels[0].shape[0]
    atlas = np.full((rows * side, columns * side), 255, np.uint8)
    vertices, texcoords, faces = [], [], []
    h = config.label_m / 2
    for k, tag_id in enumerate(config.ids):
        row, column = divmod(k, columns)
        atlas[row * side : (row + 1) * side, column * side : (column + 1) * side] = labels[k]
        x, y = config.centre(tag_id)
        vertices += [[x - h, y + h, 0], [x + h, y + h, 0], [x + h, y - h, 0], [x - h, y - h, 0]]
        texcoords += [[column, row], [column + 1, row], [column + 1, row + 1], [column, row + 1]]
        faces += [[4 * k, 4 * k + 3, 4 * k + 2], [4 * k, 4 * k + 2, 4 * k + 1]]
    add_texture(spec, "tags", np.repeat(atlas[..., None], 3, axis=2))
    add_material(spec, "tags", (1.0, 1.0, 1.0, 1.0), texture="tags", specular=MATT_SPECULAR, shininess=MATT_SHININESS)
    add_raw_mesh(
        spec,
        "tags",
        np.array(vertices),
        np.array(faces),
        normals=np.tile([0.0, 0.0, 1.0], (len(vertices), 1)),
        texcoords=np.array(texcoords) / [columns, rows],
    )
    add_visual(body, "tags_visual", "tags", material="tags").castshadow = False


def classic_finish(metallic: float, roughness: float) -> tuple[float, float]:
    """Specular and shininess that stand for a physically based finish in the classic renderer."""
    return 0.15 + 0.45 * metallic, max(0.05, 0.9 - roughness)


def pbr_finish(specular: float, shininess: float) -> tuple[float, float]:
    """Metallic and roughness, 0..1, of a finish that only says how the classic renderer draws it."""
    return min(max((specular - 0.15) / 0.45, 0.0), 1.0), min(max(0.9 - shininess, 0.05), 1.0)
