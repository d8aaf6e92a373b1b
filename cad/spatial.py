"""Rigid transforms and pinhole intrinsics: the only rotation code in the project.

Conventions: ``T_a_b`` is a (4, 4) float64 array that maps points in frame ``b`` to frame ``a``, so neighbours cancel:
``T_world_part = T_world_cam @ T_cam_part``. Metres and radians. ``cam`` is OpenCV's camera frame (+x right, +y down,
+z forward); MuJoCo's camera frame is ``camgl`` (+x right, +y up, -z forward). Pixel centres are integers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

CAM_FROM_CAMGL: Array = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns MuJoCo's camera frame into OpenCV's and back: ``T_world_cam = T_world_camgl @ CAM_FROM_CAMGL``."""


def transform(R: ArrayLike | None = None, t: ArrayLike | None = None) -> Array:
    """The (4, 4) transform with rotation ``R`` (3, 3) and translation ``t`` (3,), identity where left out."""
    T = np.eye(4)
    if R is not None:
        T[:3, :3] = R
    if t is not None:
        T[:3, 3] = t
    return T


def inverse(T: Array) -> Array:
    """``T_b_a`` from a rigid ``T_a_b`` (..., 4, 4)."""
    R_T = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_T
    out[..., :3, 3] = -(R_T @ T[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def apply(T: Array, points: ArrayLike) -> Array:
    """Points (..., 3) in frame b mapped to frame a by ``T_a_b`` (4, 4)."""
    return np.asarray(points, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def rotation_x(angle: float) -> Array:
    """(3, 3) rotation by ``angle`` rad about x."""
    return Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix()


def rotation_y(angle: float) -> Array:
    """(3, 3) rotation by ``angle`` rad about y."""
    return Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()


def rotation_z(angle: float) -> Array:
    """(3, 3) rotation by ``angle`` rad about z."""
    return Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()


def quat_wxyz_from_rotation(R: ArrayLike) -> Array:
    """Unit quaternion(s) (..., 4) in wxyz order, w >= 0, of rotation(s) (..., 3, 3)."""
    xyzw = Rotation.from_matrix(R).as_quat(canonical=True)
    return np.roll(xyzw, 1, axis=-1)


def rotation_from_quat_wxyz(quat_wxyz: ArrayLike) -> Array:
    """Rotation(s) (..., 3, 3) of wxyz quaternion(s) (..., 4), normalised first."""
    return Rotation.from_quat(np.roll(np.asarray(quat_wxyz, dtype=np.float64), -1, axis=-1)).as_matrix()


def rotation_from_rotvec(rotvec: ArrayLike) -> Array:
    """Rotation (..., 3, 3) of a rotation vector (..., 3) in rad."""
    return Rotation.from_rotvec(np.asarray(rotvec, dtype=np.float64)).as_matrix()


def rotvec_from_rotation(R: ArrayLike) -> Array:
    """Rotation vector (..., 3) in rad of rotation (..., 3, 3)."""
    return Rotation.from_matrix(np.asarray(R, dtype=np.float64)).as_rotvec()


def rotation_angle(R_a: Array, R_b: Array) -> float:
    """Angle in rad between two rotations, in [0, pi] (geodesic; accurate near zero, unlike acos of the trace)."""
    R = R_a.T @ R_b
    twice_sine = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(np.sqrt(twice_sine @ twice_sine), R[0, 0] + R[1, 1] + R[2, 2] - 1.0))


def angle_between(a: Array, b: Array) -> Array:
    """Angle(s) in rad between directions (..., 3), in [0, pi] (accurate near 0 and pi, unlike acos of the product)."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def yaw_of(R: Array) -> float:
    """The angle in rad about z that best turns the identity into ``R`` (the yaw of a rotation nearly about z)."""
    return float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))


def wrap_angle(angle: ArrayLike) -> Array:
    """Angle(s) in rad wrapped to [-pi, pi)."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi


def diameter(points: ArrayLike) -> float:
    """Largest distance between two of points (N, 3)."""
    p = np.asarray(points, dtype=np.float64)
    return float(max(cdist(p[i : i + 256], p).max() for i in range(0, len(p), 256)))


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A distortion-free pinhole camera: ``u = fx X/Z + cx``, ``v = fy Y/Z + cy``, pixel centres at integers."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"image size {self.width} x {self.height}: both must be at least 1 pixel")
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError(f"focal lengths {self.fx}, {self.fy}: both must be positive pixels")

    @property
    def matrix(self) -> Array:
        """K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, p_cam: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) in ``cam``."""
        p = np.asarray(p_cam, dtype=np.float64)
        return np.stack([self.fx * p[..., 0] / p[..., 2] + self.cx, self.fy * p[..., 1] / p[..., 2] + self.cy], axis=-1)

    def rays(self, pixels: ArrayLike) -> Array:
        """Directions (..., 3) in ``cam`` with z = 1 through pixels (..., 2)."""
        uv = np.asarray(pixels, dtype=np.float64)
        x, y = (uv[..., 0] - self.cx) / self.fx, (uv[..., 1] - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def crop(self, x0: int, y0: int, width: int, height: int) -> Intrinsics:
        """The camera that sees exactly pixels [x0, x0 + width) x [y0, y0 + height) of this one."""
        return Intrinsics(width=width, height=height, fx=self.fx, fy=self.fy, cx=self.cx - x0, cy=self.cy - y0)

    def downscaled(self, factor: int) -> Intrinsics:
        """The camera whose pixels are ``factor`` x ``factor`` blocks of this one's (area averaging)."""
        if self.width % factor or self.height % factor:
            raise ValueError(f"size {self.width} x {self.height} is not a whole multiple of the factor {factor}")
        return Intrinsics(
            width=self.width // factor,
            height=self.height // factor,
            fx=self.fx / factor,
            fy=self.fy / factor,
            cx=(self.cx + 0.5) / factor - 0.5,
            cy=(self.cy + 0.5) / factor - 0.5,
        )

    def resampled(self, width: int, height: int) -> Intrinsics:
        """The camera that sees the same with ``width`` x ``height`` pixels."""
        u, v = width / self.width, height / self.height
        return Intrinsics(
            width=width,
            height=height,
            fx=self.fx * u,
            fy=self.fy * v,
            cx=(self.cx + 0.5) * u - 0.5,
            cy=(self.cy + 0.5) * v - 0.5,
        )


BASLER_PIXEL_M = 2.4e-6
"""Pixel pitch of the Basler acA5472-17uc (Sony IMX183), Basler product page."""

BASLER = Intrinsics(
    width=5472, height=3648, fx=25e-3 / BASLER_PIXEL_M, fy=25e-3 / BASLER_PIXEL_M, cx=5471 / 2, cy=3647 / 2
)
"""Basler acA5472-17uc (5472 x 3648, 2.4 um) behind a 25 mm lens: fx = fy = 10416.67 px."""
