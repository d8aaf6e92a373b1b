"""One estimated pose against the truth: errors by comparison, the discrete choice, and the normalised error squared.

The estimate is compared as it stands (strict), modulo the part's proper symmetries, and modulo every placement that
looks the same from above. A pose of the wrong class is compared as it stands: nothing forgives it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cad.equivalence import Symmetries
from cad.parts import planar
from cad.spatial import Array, inverse, rotvec_from_rotation, yaw_of
from perception.calibration import table_from_board
from perception.estimates import PartEstimate
from perception.faces import FaceTable
from perception.ground_truth import TruePart
from perception.metrics import mssd, pose_error
from perception.outcomes import BRANCH_YAW_DEG, EQUIVALENT, STRICT, SYMMETRIC, Errors

_NO_SYMMETRY = Symmetries()


@dataclass(frozen=True, kw_only=True, eq=False)
class Placement:
    """A stable pose and where it puts the part, ``T_cam_part`` (4, 4)."""

    stable_pose: int
    T_cam_part: Array


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Whether class, face (class and stable pose) and branch (face, and yaw within 6 degrees) are right, and the yaw's
    error in degrees when the face is.
    """

    class_right: bool
    face_right: bool = False
    branch_right: bool = False
    branch_right_equivalent: bool = False
    yaw_error_deg: float | None = None


def same_views(truth: TruePart, table: FaceTable) -> list[Placement]:
    """Placements of a part that look from above as it does, itself first.

    Raises PerceptionError when its folder does not say which look alike.
    """
    face = table.index_of(truth.part.name, truth.stable_pose)
    T_cam_rest = truth.T_cam_part @ inverse(table[face].stable_pose.T_table_part)
    placements = [Placement(stable_pose=truth.stable_pose, T_cam_part=truth.T_cam_part)]
    for e in table.equivalents[face]:
        pose = table[e.face].stable_pose
        if e.face != face or e.yaw != 0.0:
            T = T_cam_rest @ planar(*e.shift_m, e.yaw) @ pose.T_table_part
            placements.append(Placement(stable_pose=pose.index, T_cam_part=T))
    return placements


def errors_by_comparison(truth: TruePart, views: list[Placement], part: str, T_cam_part: Array) -> dict[str, Errors]:
    """Errors in mm and degrees of a pose of ``part``; ``views`` are those of ``same_views``, from which the one turned
    least from the estimate counts.
    """
    strict = pose_error(truth.T_cam_part, T_cam_part, _NO_SYMMETRY).as_mm_deg()
    if part != truth.part.name:
        return {STRICT: strict, SYMMETRIC: strict, EQUIVALENT: strict}
    found = [pose_error(view.T_cam_part, T_cam_part, truth.part.symmetries).as_mm_deg() for view in views]
    return {STRICT: strict, SYMMETRIC: found[0], EQUIVALENT: min(found, key=lambda e: e["e_theta_deg"])}


def choice_of(truth: TruePart, views: list[Placement], estimate: PartEstimate, T_cam_board: Array) -> Choice:
    """What of the discrete choice is right. ``T_cam_board`` gives the vertical."""
    if estimate.part != truth.part.name:
        return Choice(class_right=False)
    right = [
        abs(yaw) <= BRANCH_YAW_DEG
        for view in views
        if view.stable_pose == estimate.stable_pose
        for yaw in [_yaw_error_deg(truth, view, estimate, T_cam_board)]
    ]
    if estimate.stable_pose != truth.stable_pose:
        return Choice(class_right=True, branch_right_equivalent=any(right))
    return Choice(
        class_right=True,
        face_right=True,
        branch_right=right[0],
        branch_right_equivalent=any(right),
        yaw_error_deg=_yaw_error_deg(truth, views[0], estimate, T_cam_board),
    )


def reading_right(truth: TruePart, views: list[Placement], estimate: PartEstimate, T_cam_board: Array) -> bool:
    """Whether the branch of one of the poses that an estimate leaves open is right, view-equivalent."""
    readings = [
        replace(estimate, part=a.part, stable_pose=a.stable_pose, T_cam_part=a.T_cam_part)
        for a in estimate.alternatives
    ]
    return any(
        choice_of(truth, views, reading, T_cam_board).branch_right_equivalent for reading in (estimate, *readings)
    )


def _yaw_error_deg(truth: TruePart, view: Placement, estimate: PartEstimate, T_cam_board: Array) -> float:
    """Signed yaw about the board's normal from the view to the estimate, modulo what the part at rest has the same."""
    alike = truth.part.rest_symmetries(view.stable_pose)
    nearest = alike.nearest(view.T_cam_part, estimate.T_cam_part)
    R_cam_table = table_from_board(T_cam_board)[:3, :3]
    turn = R_cam_table.T @ nearest[:3, :3] @ view.T_cam_part[:3, :3].T @ R_cam_table
    return float(np.degrees(yaw_of(turn)))


def surface_error_mm(truth: TruePart, estimate: PartEstimate) -> float | None:
    """MSSD; its maximum is on the convex hull. None when the class is wrong."""
    if estimate.part != truth.part.name:
        return None
    hull = truth.part.mesh.convex_hull.vertices
    return 1e3 * mssd(truth.T_cam_part, estimate.T_cam_part, hull, truth.part.symmetries)


def normalised_errors_squared(
    truth: TruePart, estimate: PartEstimate, T_cam_board: Array
) -> tuple[float | None, float | None]:
    """Of (translation, rotation vector) in ``cam``, which is chi-square with 6 degrees of freedom if the covariance
    holds; and of (x, y, yaw) on the board that the estimator saw at ``T_cam_board``, with 3. None without a covariance.
    """
    T = truth.part.symmetries.nearest(truth.T_cam_part, estimate.T_cam_part)
    error = np.concatenate(
        [truth.T_cam_part[:3, 3] - T[:3, 3], rotvec_from_rotation(truth.T_cam_part[:3, :3] @ T[:3, :3].T)]
    )
    R = table_from_board(T_cam_board)[:3, :3]
    flat = np.zeros((3, 6))
    flat[:2, :3], flat[2, 3:] = R[:, :2].T, R[:, 2]
    return _squared(error, estimate.covariance), _squared(flat @ error, flat @ estimate.covariance @ flat.T)


def _squared(error: Array, covariance: Array) -> float | None:
    """Scaled by the standard deviations first: metres and radians differ by orders of magnitude."""
    sigma = np.sqrt(np.diag(covariance))
    if not (np.isfinite(sigma).all() and (sigma > 0).all()):
        return None
    try:
        factor = np.linalg.cholesky(covariance / np.outer(sigma, sigma))
    except np.linalg.LinAlgError:
        return None
    return float(np.sum(np.linalg.solve(factor, error / sigma) ** 2))


def as_raw(estimate: PartEstimate) -> PartEstimate | None:
    """The estimate as it was before refinement; None where it had no pose then."""
    if estimate.raw_T_cam_part is None:
        return None
    return replace(
        estimate,
        T_cam_part=estimate.raw_T_cam_part,
        raw_T_cam_part=None,
        covariance=np.zeros((6, 6)),
        alternatives=(),
    )
