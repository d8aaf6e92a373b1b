"""How well a part's surface explains the image inside its silhouette: a score that needs no training.

A contour alone favours poses whose edges are few. Two symmetric measures correct that. *Fit*: under the true pose every
CAD facet is a patch of nearly linear brightness, so the description length of the image, one linear patch a facet, is
short (Rissanen's minimum description length with a Gaussian of robust width). *Unexplained*: image edges inside the
silhouette where the CAD has none speak against the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array

NOISE_LEVELS = 3.0
"""Grey levels of noise below which a better fit is no evidence."""

_SMALL_PATCH_PX = 6
_SMALL_PATCH_LEVELS = 20.0  # a patch too small to fit costs as if it were off by this
_BACKGROUND_MARGIN_PX = 2
_EDGE_SIGMA_PX = 0.7
_ROBUST_ROUNDS = 2


@dataclass(frozen=True, kw_only=True)
class RegionScore:
    """How one hypothesis explains the pixels of its part.

    ``fit``: minus the description length in nats a pixel; ``unexplained``: mean strength in [0, 1] of image edges
    inside the silhouette that no CAD edge explains.
    """

    fit: float
    unexplained: float


def region_scores(
    gray: NDArray[np.uint8] | NDArray[np.float32], labels: Sequence[NDArray[np.int32]]
) -> list[RegionScore]:
    """Scores of hypotheses on one gray image (H, W), each given by its facet map (H, W), -1 off the part.

    All are judged on the same pixels, the union of the silhouettes and a margin, so that their scores compare.
    """
    if not labels:
        return []
    for label in labels:
        if label.shape != gray.shape:
            raise ValueError(f"facet map {label.shape} and image {gray.shape} must have the same size")
    union = np.any([label >= 0 for label in labels], axis=0).astype(np.uint8)
    kernel = np.ones((2 * _BACKGROUND_MARGIN_PX + 1,) * 2, np.uint8)
    domain = cv2.dilate(union, kernel).astype(bool)
    strength = _edge_strength(gray)
    return [RegionScore(fit=_fit(gray, label, domain), unexplained=_unexplained(strength, label)) for label in labels]


def _fit(gray: NDArray[np.uint8] | NDArray[np.float32], label: NDArray[np.int32], domain: NDArray[np.bool_]) -> float:
    v, u = np.nonzero(domain)
    _, patch, count = np.unique(label[v, u], return_inverse=True, return_counts=True)
    value = gray[v, u].astype(np.float64)
    residual, scale = _linear_patches(u - gray.shape[1] / 2, v - gray.shape[0] / 2, value, patch, len(count))
    squared = np.bincount(patch, np.minimum(residual**2, (4 * scale[patch]) ** 2), len(count)) / count
    nats = np.where(
        count < _SMALL_PATCH_PX,
        count * np.log(_SMALL_PATCH_LEVELS),
        0.5 * count * np.log(NOISE_LEVELS**2 + squared) + 1.5 * np.log(len(value)),
    )
    return -float(nats.sum()) / max(len(value), 1)


def _linear_patches(u: Array, v: Array, value: Array, patch: NDArray[np.int64], n_patches: int) -> tuple[Array, Array]:
    """Residuals (P,) of values against a + b u + c v fitted to every patch robustly, and each patch's scale."""
    basis = np.stack([np.ones_like(value), u / 64.0, v / 64.0])  # (3, P)
    weight = np.ones_like(value)
    residual, scale = value, np.ones(n_patches)
    count = np.bincount(patch, minlength=n_patches)
    for _ in range(_ROBUST_ROUNDS):
        normal, right = np.empty((n_patches, 3, 3)), np.empty((n_patches, 3))
        for i in range(3):
            right[:, i] = np.bincount(patch, weight * basis[i] * value, n_patches)
            for j in range(i, 3):
                normal[:, i, j] = normal[:, j, i] = np.bincount(patch, weight * basis[i] * basis[j], n_patches)
        normal += 1e-3 * np.eye(3)
        coefficients = np.linalg.solve(normal, right[..., None])[..., 0]  # (patches, 3)
        residual = value - (coefficients[patch].T * basis).sum(axis=0)
        scale = 1.25 * np.bincount(patch, np.abs(residual), n_patches) / count + NOISE_LEVELS
        weight = 1.0 / (1.0 + (residual / (2 * scale[patch])) ** 2)
    return residual, scale


def _edge_strength(gray: NDArray[np.uint8] | NDArray[np.float32]) -> Array:
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), _EDGE_SIGMA_PX)
    gu = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8)
    gv = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    magnitude = np.hypot(gu, gv).astype(np.float64)
    return magnitude / (magnitude + 2.5 * np.median(magnitude) + 1.0)


def _unexplained(strength: Array, label: NDArray[np.int32]) -> float:
    inside = label >= 0
    if not inside.any():
        return 1.0
    border = (label != np.roll(label, 1, axis=0)) | (label != np.roll(label, 1, axis=1))
    near = cv2.dilate(border.astype(np.uint8), np.ones((4, 4), np.uint8)).astype(bool)
    return float(strength[inside & ~near].sum() / (inside.sum() + 1))
