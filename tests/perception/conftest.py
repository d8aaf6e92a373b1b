"""Parts and pictures without a renderer: solids made of boxes, shaded by facet, blurred and noisy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from cad.equivalence import Symmetries
from cad.parts import Part, StablePose, planar
from cad.spatial import BASLER, Array, Intrinsics, apply, rotation_x, rotation_y, transform
from perception.silhouette import render_view, solid_of


def make_part(mesh: trimesh.Trimesh, rotations: tuple[Array, ...] = (np.eye(3),), name: str = "block") -> Part:
    """A part at rest on the plane in each of the given orientations, its footprint centred on the origin."""
    poses = []
    for i, R in enumerate(rotations):
        corners = mesh.vertices @ R.T
        low, high = corners.min(axis=0), corners.max(axis=0)
        t = np.array([-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]])
        poses.append(
            StablePose(
                index=i,
                R_table_part=R,
                t_table_part=t,
                probability=1 / len(rotations),
                view_class=i,
                view_equivalents=(),
            )
        )
    return Part(
        name=name,
        obj_id=1,
        folder=Path("."),
        mass_kg=1e-3,
        material="steel",
        rgba=(0.5, 0.5, 0.5, 1.0),
        metallic=1.0,
        roughness=0.5,
        mesh=mesh,
        symmetries=Symmetries(),
        stable_poses=tuple(poses),
        keypoints=np.asarray(mesh.bounding_box.vertices, dtype=np.float64),
        mesh_hash="",
    )


def box(size_mm: tuple[float, float, float], at_mm: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    """A box with its lower face's centre at ``at_mm``."""
    mesh = trimesh.creation.box(extents=np.array(size_mm) * 1e-3)
    mesh.apply_translation(np.array([at_mm[0], at_mm[1], at_mm[2] + size_mm[2] / 2]) * 1e-3)
    return mesh


@pytest.fixture(scope="session")
def plain_box() -> Part:
    return make_part(box((8, 6, 2)))


@pytest.fixture(scope="session")
def stepped() -> Part:
    """A plate with two unlike blocks on it: no two of its placements look the same; face 1 is upside down."""
    pieces = [box((8.6, 6.2, 1.2)), box((2.4, 3.0, 1.0), (-2.4, 0.9, 1.2)), box((1.2, 5.0, 0.7), (2.6, 0.2, 1.2))]
    return make_part(trimesh.util.concatenate(pieces), (np.eye(3), np.diag([1.0, -1.0, -1.0])), name="stepped")


@dataclass(frozen=True)
class Picture:
    gray: Any
    intrinsics: Intrinsics
    T_cam_table: Array
    x: float
    y: float
    yaw: float


def draw(part: Part, stable_pose: int, seed: int, size: int = 256, noise: float = 2.0) -> Picture:
    """A full-resolution crop of a part somewhere on the table, drawn three times finer and averaged."""
    rng = np.random.default_rng(seed)
    tilt = np.radians(rng.uniform(-0.7, 0.7, 2))
    T_cam_table = transform(rotation_x(np.pi + tilt[0]) @ rotation_y(tilt[1]), [0, 0, 0.7 + rng.uniform(-8e-3, 8e-3)])
    x, y, yaw = rng.uniform(-0.07, 0.07), rng.uniform(-0.04, 0.04), rng.uniform(-np.pi, np.pi)
    T_cam_part = T_cam_table @ planar(x, y, yaw) @ part.stable_poses[stable_pose].T_table_part
    centre = np.round(BASLER.project(apply(T_cam_table, [x, y, 1e-3])) + rng.uniform(-20, 20, 2)).astype(int)
    window = BASLER.crop(int(centre[0]) - size // 2, int(centre[1]) - size // 2, size, size)
    n = 3
    fine = Intrinsics(
        width=size * n,
        height=size * n,
        fx=window.fx * n,
        fy=window.fy * n,
        cx=(window.cx + 0.5) * n - 0.5,
        cy=(window.cy + 0.5) * n - 0.5,
    )
    view = render_view(part, T_cam_part, fine)
    solid = solid_of(part)
    normals = np.zeros((solid.facet.max() + 1, 3))
    np.add.at(normals, solid.facet, solid.normals @ T_cam_part[:3, :3].T)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    lamp = np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), -1.0])
    shade = 90 + 90 * np.clip(normals @ (lamp / np.linalg.norm(lamp)), 0, 1)
    levels = np.where(view.mask, shade[view.facet], 50.0).astype(np.float32)
    image = cv2.GaussianBlur(cv2.resize(levels, (size, size), interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    gray = np.clip(image + rng.normal(0, noise, image.shape), 0, 255).astype(np.uint8)
    return Picture(gray, window, T_cam_table, x, y, yaw)


@pytest.fixture(scope="session")
def picture_of() -> Any:
    return draw
