"""A camera looking at a table: the one mapping from a part's (x, y, yaw) to pixels, with its Jacobian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cad.spatial import Array, Intrinsics, inverse
from perception.edges import EdgeSamples


@dataclass(frozen=True, kw_only=True, eq=False)
class TableCamera:
    """Intrinsics and ``T_cam_table`` (4, 4). A ``pose`` is (x, y, yaw), metres and radians, in the table frame."""

    intrinsics: Intrinsics
    T_cam_table: Array

    def project(self, samples: EdgeSamples, pose: Array) -> tuple[Array, Array, Array]:
        """Pixels (N, 2), unit normals (N, 2) and the normal displacement's Jacobian (N, 3) by ``pose`` = (x, y, yaw).

        Where a tangent points at the camera the normal is zero.
        """
        x, y, yaw = pose
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        R_cam_table = self.T_cam_table[:3, :3]
        turned = samples.points @ R.T
        p_cam = (turned + np.array([x, y, 0.0])) @ R_cam_table.T + self.T_cam_table[:3, 3]
        k, z = self.intrinsics, p_cam[:, 2]
        ray_u, ray_v = p_cam[:, 0] / z, p_cam[:, 1] / z
        pixels = np.stack([k.fx * ray_u + k.cx, k.fy * ray_v + k.cy], axis=1)

        def moved(d_cam: Array) -> Array:
            """Pixel velocity (N, 2) of points moving with d_cam (N, 3) or (3,)."""
            du = k.fx * (d_cam[..., 0] - ray_u * d_cam[..., 2]) / z
            dv = k.fy * (d_cam[..., 1] - ray_v * d_cam[..., 2]) / z
            return np.stack([du, dv], axis=1)

        along = moved(samples.tangents @ R.T @ R_cam_table.T)
        length = np.linalg.norm(along, axis=1)
        foreshortened = length < 0.25 * k.fx / z
        normals = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(length, 1e-9)[:, None]
        normals[foreshortened] = 0.0
        spin = np.stack([-turned[:, 1], turned[:, 0], np.zeros(len(turned))], axis=1) @ R_cam_table.T
        columns = (moved(R_cam_table[:, 0]), moved(R_cam_table[:, 1]), moved(spin))
        jacobian = np.stack([(column * normals).sum(axis=1) for column in columns], axis=1)
        return pixels, normals, jacobian

    def eye(self, pose: Array) -> Array:
        """Where the camera is (3,), in the frame ``rest`` of a part at ``pose``."""
        x, y, yaw = pose
        dx, dy, dz = inverse(self.T_cam_table)[:3, 3] - [x, y, 0.0]
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([c * dx + s * dy, -s * dx + c * dy, dz])

    def shifted(self, pose: Array, du: float, dv: float) -> Array:
        """The pose whose image is that of ``pose`` moved by (du, dv) pixels, to first order."""
        shift = self.T_cam_table[:3, :3].T @ (np.array([du, dv, 0.0]) * self.metres_per_pixel(pose))
        return pose + np.array([shift[0], shift[1], 0.0])

    def metres_per_pixel(self, pose: Array) -> float:
        """Size on the table of a pixel at the part."""
        return float((self.T_cam_table[:3, :3] @ [pose[0], pose[1], 0.0] + self.T_cam_table[:3, 3])[2]) / (
            self.intrinsics.fx
        )
