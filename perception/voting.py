"""Keypoints from votes: pure functions from per-pixel votes to keypoints and their covariance.

Every function takes the pixels that vote, ``pixels`` (P, 2), in any pixel unit, and answers in the same unit. Two kinds
of vote: unit vectors towards each keypoint with RANSAC, as PVNet does (Peng et al., CVPR 2019, section 3.1), and
offsets to each keypoint with a confidence, combined by their weighted geometric median.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cad.spatial import Array
from perception.estimates import PerceptionError

HYPOTHESES = 128
INLIER_COSINE = 0.99  # PVNet, section 3.1
MINIMUM_PIXELS = 4
COVARIANCE_FLOOR = 0.05**2  # px^2, so that a covariance can always be inverted


class VotingError(PerceptionError):
    """Too few pixels, or shapes that do not fit each other."""


def vector_field(mask: ArrayLike, keypoints: ArrayLike) -> NDArray[np.float32]:
    """PVNet's training target (H, W, K, 2): at each pixel of ``mask`` (H, W) the unit vectors towards the ``keypoints``
    (K, 2), pixels u, v; zero beside the mask and where a keypoint is at the pixel itself.
    """
    inside, points = np.asarray(mask, dtype=bool), np.asarray(keypoints, dtype=np.float64)
    if inside.ndim != 2 or points.ndim != 2 or points.shape[1] != 2:
        raise VotingError(f"mask {inside.shape} and keypoints {points.shape}: expected (H, W) and (K, 2)")
    v, u = np.nonzero(inside)
    towards = points - np.stack([u, v], axis=-1)[:, None]
    distance = np.linalg.norm(towards, axis=-1, keepdims=True)
    field = np.zeros((*inside.shape, len(points), 2), np.float32)
    field[v, u] = np.divide(towards, distance, out=np.zeros_like(towards), where=distance > 0)
    return field


def ransac_vote(
    pixels: ArrayLike, directions: ArrayLike, rng: np.random.Generator, hypotheses: int = HYPOTHESES
) -> tuple[Array, Array]:
    """Keypoints (K, 2) and covariances (K, 2, 2) from unit vectors ``directions`` (P, K, 2) at ``pixels`` (P, 2).

    Hypotheses are intersections of the lines of two random pixels; a pixel votes for the hypotheses that it points to
    within acos(0.99). The keypoint is the least-squares intersection of the winner's inliers, the covariance that of
    the hypotheses about it, weighted by their votes (PVNet, equations 1 to 3). Raises VotingError under 4 pixels.
    """
    p, d = _checked(pixels, directions)
    d = d / np.maximum(np.linalg.norm(d, axis=-1, keepdims=True), 1e-9)
    points, found = _intersections(p, d, rng, hypotheses)
    votes = _votes(p, d, points) * found
    best = votes.argmax(axis=1)
    n_keypoints = d.shape[1]
    keypoints, covariances = np.empty((n_keypoints, 2)), np.empty((n_keypoints, 2, 2))
    for k in range(n_keypoints):
        inliers = _points_to(p, d[:, k], points[k, best[k]]) if found[k].any() else np.zeros(len(p), bool)
        keypoints[k] = _nearest_to_lines(p[inliers], d[inliers, k]) if inliers.sum() >= 2 else p.mean(axis=0)
        weight = votes[k] if votes[k].sum() > 0 else np.ones(points.shape[1])
        spread = points[k] - keypoints[k]
        covariances[k] = np.einsum("h,hi,hj->ij", weight / weight.sum(), spread, spread)
    return keypoints, covariances + COVARIANCE_FLOOR * np.eye(2)


def offset_vote(pixels: ArrayLike, offsets: ArrayLike, log_scale: ArrayLike) -> tuple[Array, Array]:
    """Keypoints (K, 2) and covariances (K, 2, 2) from ``offsets`` (P, K, 2) with log standard deviation (P, K).

    The keypoint is the geometric median of pixel + offset, weighted by the inverse variances (Weiszfeld's iteration);
    the covariance is that of the votes about it. Raises VotingError under 4 pixels.
    """
    p, o = _checked(pixels, offsets)
    s = np.clip(np.asarray(log_scale, dtype=np.float64), -5.0, 5.0)
    if s.shape != o.shape[:2]:
        raise VotingError(f"log_scale has shape {s.shape}, offsets ask for {o.shape[:2]}")
    weight = np.exp(-2.0 * (s - s.min(axis=0)))
    weight /= weight.sum(axis=0)  # (P, K)
    votes = p[:, None] + o  # (P, K, 2)
    keypoints = np.einsum("pk,pki->ki", weight, votes)
    for _ in range(5):
        distance = np.linalg.norm(votes - keypoints, axis=-1)
        pull = weight / np.maximum(distance, 0.25)
        keypoints = np.einsum("pk,pki->ki", pull, votes) / pull.sum(axis=0)[:, None]
    spread = votes - keypoints
    covariances = np.einsum("pk,pki,pkj->kij", weight, spread, spread)
    return keypoints, covariances + COVARIANCE_FLOOR * np.eye(2)


def _checked(pixels: ArrayLike, votes: ArrayLike) -> tuple[Array, Array]:
    p, v = np.asarray(pixels, dtype=np.float64), np.asarray(votes, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 2 or v.ndim != 3 or v.shape[0] != p.shape[0] or v.shape[2] != 2:
        raise VotingError(f"pixels {p.shape} and votes {v.shape}: expected (P, 2) and (P, K, 2)")
    if len(p) < MINIMUM_PIXELS:
        raise VotingError(f"{len(p)} pixels vote; at least {MINIMUM_PIXELS} are needed (is the mask empty?)")
    return p, v


def _intersections(p: Array, d: Array, rng: np.random.Generator, hypotheses: int) -> tuple[Array, NDArray[np.bool_]]:
    """Intersections (K, H, 2) of the lines of random pairs of pixels, and which of them exist (K, H)."""
    k = np.arange(d.shape[1])[:, None]
    i, j = rng.integers(len(p), size=(2, d.shape[1], hypotheses))
    d_i, d_j, gap = d[i, k], d[j, k], p[j] - p[i]
    cross = d_i[..., 0] * d_j[..., 1] - d_i[..., 1] * d_j[..., 0]
    found = np.abs(cross) > 0.02
    along = (gap[..., 0] * d_j[..., 1] - gap[..., 1] * d_j[..., 0]) / np.where(found, cross, 1.0)
    return p[i] + np.where(found, along, 0.0)[..., None] * d_i, found


def _votes(p: Array, d: Array, points: Array) -> Array:
    """How many pixels (K, H) point to each of the points (K, H, 2)."""
    to_point = points[:, :, None] - p  # (K, H, P, 2)
    towards = np.einsum("khpi,pki->khp", to_point, d)
    return (towards > INLIER_COSINE * np.linalg.norm(to_point, axis=-1)).sum(axis=-1)


def _points_to(p: Array, d: Array, point: Array) -> NDArray[np.bool_]:
    """Whether the direction(s) ``d`` at ``p`` point to ``point`` within the inlier angle; shapes broadcast."""
    to_point = point - p
    distance = np.linalg.norm(to_point, axis=-1)
    return (to_point * d).sum(-1) > INLIER_COSINE * np.maximum(distance, 1e-9)


def _nearest_to_lines(p: Array, d: Array) -> Array:
    """The point (2,) with the least sum of squared distances to the lines through ``p`` (P, 2) along ``d`` (P, 2)."""
    A = len(p) * np.eye(2) - d.T @ d
    b = p.sum(axis=0) - d.T @ (p * d).sum(axis=1)
    return np.linalg.solve(A + 1e-6 * np.eye(2), b)
