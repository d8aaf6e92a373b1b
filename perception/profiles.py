"""Brightness profiles across a contour, modelled as what the CAD says they show.

Edges closer than the blur (chamfers, thin walls seen aslant) merge into one gradient peak that lies on neither. So each
profile is modelled as patches of constant brightness between known borders, blurred. The brightnesses are free and
eliminated from the least squares (variable projection, Golub and Pereyra 1973). What remains unexplained tells right
from wrong placements, and its derivative moves x, y and yaw of the part by Gauss-Newton.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cad.spatial import Array
from perception.edges import MAX_PATCHES, PATCH_OFFSETS_M, EdgeSamples
from perception.gradients import Image32
from perception.table_camera import TableCamera


@dataclass(frozen=True, kw_only=True)
class ProfileConfig:
    """Lengths in pixels of the crop, brightness in grey levels."""

    half_length_px: float = 4.0
    step_px: float = 0.5
    blur_px: float = 0.8
    reach_px: float = 1.5
    noise_levels: float = 0.7

    def __post_init__(self) -> None:
        if not 0 < self.step_px < self.half_length_px:
            raise ValueError(f"step {self.step_px} px must be positive and below half the length {self.half_length_px}")
        if min(self.blur_px, self.reach_px, self.noise_levels) <= 0:
            raise ValueError(f"blur {self.blur_px}, reach {self.reach_px}, noise {self.noise_levels}: must be positive")


@dataclass(frozen=True, kw_only=True)
class ProfileFit:
    """A pose (x, y, yaw) in the table frame with its covariance (3, 3).

    ``explained`` in [0, 1] is the mean share of a profile's brightness variance that the model explains.
    """

    pose: Array
    covariance: Array
    explained: float


class ProfileModel:
    """Modelled profiles of one set of edge samples, at the size they have in one camera."""

    def __init__(
        self, samples: EdgeSamples, camera: TableCamera, metres_per_pixel: float, config: ProfileConfig | None = None
    ) -> None:
        self.samples, self.camera, self.config = samples, camera, config or ProfileConfig()
        c = self.config
        self._offsets_px = np.arange(-c.half_length_px, c.half_length_px + 1e-6, c.step_px)  # (S,)
        away = (self._offsets_px[:, None] - PATCH_OFFSETS_M / metres_per_pixel) / c.blur_px  # (S, T)
        kernel = np.exp(-0.5 * away**2)
        kernel /= kernel.sum(axis=1, keepdims=True)
        one_hot = (samples.patches[..., None] == np.arange(MAX_PATCHES)).astype(np.float32)  # (N, T, M)
        both = np.matmul(np.concatenate([kernel, -kernel * away / c.blur_px]).astype(np.float32), one_hot)
        basis, slope = both[:, : len(kernel)], both[:, len(kernel) :]  # (N, S, M), and its derivative by the offset
        transposed = basis.transpose(0, 2, 1)
        solver = np.linalg.solve(transposed @ basis + 1e-3 * np.eye(MAX_PATCHES, dtype=np.float32), transposed)
        # From a profile to what its patches leave unexplained, and to how it would change if the edge moved by a
        # pixel, less what a change of the patches' brightness can imitate: (N, S, S) each.
        self._unexplained = np.eye(len(kernel), dtype=np.float32) - basis @ solver
        self._moved = -self._unexplained @ (slope @ solver)

    def explained_at(self, image: Image32, pose: Array, shifts_px: Array) -> Array:
        """What share in [0, 1] of the brightness variance the model explains at ``pose`` shifted by (P, 2) pixels."""
        pixels, normals, _ = self.camera.project(self.samples, pose)
        n_shifts, n_samples, length = len(shifts_px), len(pixels), len(self._offsets_px)
        at = pixels[:, None] + self._offsets_px[:, None] * normals[:, None]  # (N, S, 2)
        moved = (at + shifts_px[:, None, None]).reshape(n_shifts, -1, 2).astype(np.float32)
        seen = cv2.remap(image, moved, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # pyright: ignore[reportCallIssue, reportArgumentType]
        seen = seen.reshape(n_shifts, n_samples, length).transpose(1, 2, 0)  # (N, S, P)
        seen = seen - seen.mean(axis=1, keepdims=True)
        return self._explained(seen, self._unexplained @ seen, normals)

    def fit(self, image: Image32, pose: Array, rounds: int) -> ProfileFit:
        """Move ``pose`` (x, y, yaw), right within about a pixel, so that the model matches a gray image (H, W)."""
        pose, information, explained = pose.copy(), np.eye(3), 0.0
        unit = np.array([1e-4, 1e-4, 1e-2])  # about a pixel each
        degrees = max(len(self._offsets_px) - MAX_PATCHES, 1)
        for _ in range(rounds):
            pixels, normals, jacobian = self.camera.project(self.samples, pose)
            seen = self._read(image, pixels, normals)
            residual = np.einsum("nst,nt->ns", self._unexplained, seen)
            moved = np.einsum("nst,nt->ns", self._moved, seen)
            power, pull = (moved**2).sum(axis=1), (moved * residual).sum(axis=1)
            far = np.clip(1 - (pull / (power + 1e-9) / self.config.reach_px) ** 2, 0.0, 1.0) ** 2
            variance = (residual**2).sum(axis=1) / degrees + self.config.noise_levels**2
            weight = self.samples.weights * normals.any(axis=1) * far / variance
            scaled = jacobian * unit
            information = (scaled * (weight * power)[:, None]).T @ scaled
            ridge = (1e-6 * np.trace(information) + 1e-9) * np.eye(3)
            step = np.linalg.solve(information + ridge, scaled.T @ (weight * pull)) * unit
            pose = pose + np.clip(step, [-1e-4, -1e-4, -0.02], [1e-4, 1e-4, 0.02])
            explained = float(self._explained(seen, residual, normals))
        covariance = np.linalg.inv(information + 1e-9 * np.eye(3)) * np.outer(unit, unit)
        return ProfileFit(pose=pose, covariance=np.asarray(covariance, dtype=np.float64), explained=explained)

    def _read(self, image: Image32, pixels: Array, normals: Array) -> Image32:
        """Brightness (N, S) along the normals, each profile's mean taken off."""
        u = (pixels[:, :1] + self._offsets_px * normals[:, :1]).astype(np.float32)
        v = (pixels[:, 1:] + self._offsets_px * normals[:, 1:]).astype(np.float32)
        seen = cv2.remap(image, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(seen - seen.mean(axis=1, keepdims=True), dtype=np.float32)

    def _explained(self, seen: Array | Image32, residual: Array | Image32, normals: Array) -> Array:
        """Mean over samples of what (N, S, ...) profiles have explained, (...)."""
        weight = self.samples.weights * normals.any(axis=1)
        noise = self.config.noise_levels**2 * len(self._offsets_px)
        share = (residual**2).sum(axis=1) / ((seen**2).sum(axis=1) + noise)
        return 1.0 - (weight @ share) / (float(weight.sum()) + 1e-9)
