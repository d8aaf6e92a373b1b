"""A covariance that holds: how far poses of resting parts are off, as seen on validation frames.

An error has six parts, one for each thing that goes wrong on its own. In the table's plane, x, y and yaw of the
contour: the covariance of Gauss-Newton, scaled, since neighbouring profiles are not independent, and a floor, since
chamfers and shadows pull edges the same way. Both grow where the contour matches the image badly and where the gate has
its doubts: a contour that clings to shadows or parallel edges shows by that, not by Gauss-Newton. Off the plane, what a
resting pose takes as exact: the height of the table below the part, read from the tags, and the part's lean on it. A
wrong height moves a part along the ray to the camera, because its image stays where it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from cad.spatial import Array, apply, rotvec_from_rotation
from perception.contour import Refinement

GROSS = 300.0
"""Normalised error squared, of six degrees, beyond which an estimate counts as an outlier when the noise is fitted."""
FEWEST = 20
"""Estimates of a part that are needed to fit its noise."""
QUALITIES = ("matched_fraction", "correlation", "explained")
"""Scores of a contour, 1 for a perfect one, whose shortfall makes errors larger; so does the gate's doubt."""
NO_DOUBT_NATS = 6.0
"""Log-odds of being right from which there is no doubt; there is as much as 1 at even odds."""
LEAST_MOST_MEAN = (0.3, 12.0)
"""Limits of the mean normalised error squared, of three degrees, that the noise is scaled by."""
MOST_GROWTH = 4.0
"""Natural logarithm of the most that a bad contour makes of an error's standard deviation."""


@dataclass(frozen=True, kw_only=True)
class NoiseModel:
    """Standard deviations that the contour's own covariance does not know of.

    ``scale`` multiplies the covariance of Gauss-Newton; ``floor_m`` (x and y) and ``floor_rad`` (yaw) are added to it
    in squares. Both are for a perfect contour beyond doubt; for each of the ``QUALITIES``, and for the doubt,
    ``growth`` says how much the logarithm of the standard deviation grows with the shortfall. ``height_m`` is that of
    the table's height at the part, ``lean_rad`` that of the part's lean.
    """

    scale: float = 4.0
    floor_m: float = 1.6e-5
    floor_rad: float = float(np.radians(0.05))
    height_m: float = 3e-5
    lean_rad: float = float(np.radians(0.15))
    growth: tuple[float, ...] = (0.0,) * (len(QUALITIES) + 1)

    def __post_init__(self) -> None:
        for name in ("scale", "floor_m", "floor_rad", "height_m", "lean_rad"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be above 0")
        if len(self.growth) != len(QUALITIES) + 1:
            raise ValueError(f"growth = {self.growth}: must have a number for each of {', '.join(QUALITIES)}, doubt")

    def flat(self, planar: Array, shortfall: Array) -> Array:
        """Covariance (..., 3, 3) of (x, y, yaw) from Gauss-Newton's (..., 3, 3) and the shortfall (..., 4)."""
        grown = np.exp(2 * np.minimum(shortfall @ np.array(self.growth), MOST_GROWTH))[..., None, None]
        return grown * (self.scale * planar + np.diag(np.square([self.floor_m, self.floor_m, self.floor_rad])))

    def widened(self, factor: float) -> NoiseModel:
        """The same with ``factor`` times the covariance of x, y and yaw."""
        root = float(np.sqrt(factor))
        return replace(self, scale=self.scale * factor, floor_m=self.floor_m * root, floor_rad=self.floor_rad * root)

    def inner(self, planar: Array, shortfall: Array) -> Array:
        """Covariance (6, 6) of (x, y, yaw, height, lean, lean) from Gauss-Newton's (3, 3) and the shortfall (4,)."""
        out = np.diag(np.square([0.0, 0.0, 0.0, self.height_m, self.lean_rad, self.lean_rad]))
        out[:3, :3] = self.flat(planar, shortfall)
        return out


def shortfall_of(qualities: Sequence[float], probability: float) -> Array:
    """What (4,) a contour lacks of a perfect one in each of the ``QUALITIES``, and the doubt that it is right."""
    p = float(np.clip(probability, 1e-6, 1 - 1e-6))
    doubt = np.clip(1.0 - np.log(p / (1.0 - p)) / NO_DOUBT_NATS, 0.0, 2.0)
    return np.append(1.0 - np.asarray(qualities, np.float64), doubt)


def pose_jacobian(T_cam_table: Array, T_cam_part: Array, x: float, y: float) -> Array:
    """Derivative (6, 6) of (translation, rotation vector) in ``cam`` by (x, y, yaw, height, lean about x, about y).

    ``x``, ``y`` is the footprint's centre in the table frame, about which yaw and lean turn.
    """
    R = T_cam_table[:3, :3]
    foot = apply(T_cam_table, [x, y, 0.0])
    arm = T_cam_part[:3, 3] - foot
    J = np.zeros((6, 6))
    J[:3, 0], J[:3, 1] = R[:, 0], R[:, 1]
    J[:3, 3] = foot / float(R[:, 2] @ foot)  # along the ray, by one unit of height
    for column, axis in ((2, R[:, 2]), (4, R[:, 0]), (5, R[:, 1])):
        J[:3, column], J[3:, column] = np.cross(axis, arm), axis
    return J


def pose_covariance(
    contour: Refinement, probability: float, noise: NoiseModel, T_cam_table: Array, T_cam_part: Array
) -> Array:
    """Covariance (6, 6) of (translation m, rotation vector rad) in ``cam`` of a part that a contour was laid on, which
    is right with a ``probability``.
    """
    J = pose_jacobian(T_cam_table, T_cam_part, contour.x, contour.y)
    shortfall = shortfall_of([getattr(contour, name) for name in QUALITIES], probability)
    return J @ noise.inner(contour.covariance, shortfall) @ J.T


def inner_error(T_cam_part_true: Array, T_cam_part: Array, T_cam_table: Array, x: float, y: float) -> Array:
    """What is wrong (6,) with an estimate, as (x, y, yaw, height, lean about x, lean about y): truth minus estimate."""
    turn = rotvec_from_rotation(T_cam_part_true[:3, :3] @ T_cam_part[:3, :3].T)
    apart = np.concatenate([T_cam_part_true[:3, 3] - T_cam_part[:3, 3], turn])
    return np.asarray(np.linalg.solve(pose_jacobian(T_cam_table, T_cam_part, x, y), apart), np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Errors:
    """Errors of N estimates ``by_cause`` (N, 6) as from :func:`inner_error`, Gauss-Newton's covariances ``planar``
    (N, 3, 3), the shortfalls of their contours (N, 4) and which are accepted (N,).
    """

    by_cause: Array
    planar: Array
    shortfall: Array
    accepted: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.by_cause)

    def take(self, rows: NDArray[np.bool_]) -> Errors:
        """Some of them."""
        return Errors(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def normalised_squares(errors: Errors, noise: NoiseModel) -> tuple[Array, Array]:
    """Normalised errors squared (N,) of x, y, yaw (3 degrees of freedom) and of the whole pose (6)."""
    e = errors.by_cause
    scaled = np.linalg.solve(noise.flat(errors.planar, errors.shortfall), e[:, :3, None])[..., 0]
    flat = np.einsum("ni,ni->n", e[:, :3], scaled)
    rest = (e[:, 3:] / [noise.height_m, noise.lean_rad, noise.lean_rad]) ** 2
    return flat, flat + rest.sum(axis=1)


def joined(errors: Sequence[Errors]) -> Errors:
    """One after the other."""
    return Errors(**{field.name: np.concatenate([getattr(e, field.name) for e in errors]) for field in fields(Errors)})


def face_name(part: str, stable_pose: int) -> str:
    """What the noise of a part that rests on one stable pose is kept under; that of all its poses under the part."""
    return f"{part} {stable_pose}"


def part_of(face: str) -> str:
    """The part of a :func:`face_name`."""
    return face.rsplit(" ", 1)[0]


def noise_of(noise: Mapping[str, NoiseModel], face: str) -> NoiseModel | None:
    """The noise of a :func:`face_name`, that of its part where there is none; None where nothing is known of it."""
    return noise.get(face, noise.get(part_of(face)))


def with_parts(by_face: Mapping[str, Errors]) -> dict[str, Errors]:
    """Errors by face, and by part those of all its faces."""
    out = dict(by_face)
    for part in sorted({part_of(face) for face in by_face}):
        out[part] = joined([errors for face, errors in by_face.items() if part_of(face) == part])
    return out


def fit_noise(folds: Sequence[Mapping[str, Errors]]) -> dict[str, NoiseModel]:
    """The noise of every part, and every face, of which there are 20 estimates, from errors by face in folds of frames.

    It is that of greatest likelihood, widened or narrowed to what the accepted ones show in a fold that it was not
    fitted on: a model that has seen few errors has seen few of the large ones, and one of large errors too is too wide
    for those that are acted upon.
    """
    noise = _fitted(folds)
    if len(folds) < 2:
        return noise
    squares: dict[str, list[Array]] = {}
    for i, fold in enumerate(folds):
        others = _fitted([other for k, other in enumerate(folds) if k != i])
        for name, errors in with_parts(fold).items():
            if name in others:
                accepted = errors.take(errors.accepted)
                squares.setdefault(name, []).append(normalised_squares(accepted, others[name])[0])
    factor = {name: _mean_of(np.concatenate(found)) / 3.0 for name, found in squares.items()}
    return {name: model.widened(factor.get(name, 1.0)) for name, model in noise.items()}


def _mean_of(squares: Array) -> float:
    """The mean of normalised errors squared of 3 degrees of freedom, 3 of too few."""
    return float(np.clip(squares.mean(), *LEAST_MOST_MEAN)) if len(squares) >= FEWEST else 3.0


def _fitted(folds: Sequence[Mapping[str, Errors]]) -> dict[str, NoiseModel]:
    """Greatest likelihood; how errors grow with bad contours all have in common. Gross outliers are left out: it is for
    the gate to find them.
    """
    faces = sorted({face for fold in folds for face in fold})
    named = with_parts({face: joined([fold[face] for fold in folds if face in fold]) for face in faces})
    enough = {name: errors for name, errors in named.items() if len(errors) >= FEWEST}
    parts = {name: errors for name, errors in enough.items() if name not in faces}
    if not parts:
        return {}
    noise = {name: _typical(errors) for name, errors in enough.items()}
    for _ in range(2):
        kept = {name: e.take(normalised_squares(e, noise[name])[1] < GROSS) for name, e in enough.items()}
        noise = _likeliest({name: kept[name] for name in parts}, growth=None)
        growth = next(iter(noise.values())).growth
        for name in enough.keys() - parts.keys():
            noise |= _likeliest({name: kept[name]}, growth)
    return noise


def _typical(errors: Errors) -> NoiseModel:
    """Standard deviations that half of the errors suggest."""
    x, y, yaw, height, *lean = 1.5 * np.median(np.abs(errors.by_cause), axis=0) + 1e-9
    return NoiseModel(
        scale=1.0,
        floor_m=float(x + y) / 2,
        floor_rad=float(yaw),
        height_m=float(height),
        lean_rad=float(np.mean(lean)),
    )


def _off_plane(errors: Errors) -> Array:
    """Height and lean (N, 3) of the accepted ones, of all when these are few."""
    accepted = errors.take(errors.accepted) if np.count_nonzero(errors.accepted) >= FEWEST else errors
    return accepted.by_cause[:, 3:]


_UNIT = np.array([1e-5, 1e-5, 1e-3])  # so that all is near one
_START = np.log([100.0, 1.0, 1.0])


def _likeliest(by_name: Mapping[str, Errors], growth: tuple[float, ...] | None) -> dict[str, NoiseModel]:
    """Noise of greatest likelihood, with the growth that all have in common unless that is given."""
    names, n_growth = list(by_name), len(QUALITIES) + 1 if growth is None else 0
    count = sum(len(errors) for errors in by_name.values())
    upright = {name: _off_plane(errors) for name, errors in by_name.items()}

    def unpacked(values: Array) -> dict[str, NoiseModel]:
        grows = tuple(values[3 * len(names) :].tolist()) if growth is None else growth
        logs = values[: 3 * len(names)].reshape(-1, 3)
        return {
            name: NoiseModel(
                scale=float(np.exp(scale)),
                floor_m=float(np.exp(floor) * _UNIT[0]),
                floor_rad=float(np.exp(floor_yaw) * _UNIT[2]),
                height_m=float(np.sqrt(np.mean(upright[name][:, 0] ** 2)) + 1e-7),
                lean_rad=float(np.sqrt(np.mean(upright[name][:, 1:] ** 2)) + 1e-6),
                growth=grows,
            )
            for name, (scale, floor, floor_yaw) in zip(names, logs, strict=True)
        }

    def loss(values: Array) -> float:
        total = 0.0
        for name, noise in unpacked(values).items():
            errors = by_name[name]
            S = noise.flat(errors.planar, errors.shortfall) / np.outer(_UNIT, _UNIT)
            e = errors.by_cause[:, :3] / _UNIT
            squares = np.einsum("ni,ni->n", e, np.linalg.solve(S, e[..., None])[..., 0])
            total += float((np.linalg.slogdet(S)[1] + squares).sum()) / count
        # A weak pull to the start decides where scale, floor and growth can stand for each other.
        return total + 1e-3 * float(np.sum((values - first) ** 2))

    first = np.append(np.tile(_START, len(names)), np.zeros(n_growth))
    bounds = [(value - 8.0, value + 8.0) for value in first[: 3 * len(names)]] + [(0.0, 10.0)] * n_growth
    return unpacked(minimize(loss, first, method="L-BFGS-B", bounds=bounds).x)
