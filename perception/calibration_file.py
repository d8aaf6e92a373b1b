"""What is known of one cell's camera, board and robot: ``calibration.json``, read, checked and written.

The file is JSON with a ``format`` and a ``version``. Only the camera (``intrinsics``, and ``distortion`` where the lens
has any) is needed to estimate poses in photographs; the rest is what calibrating a cell adds. Lengths are metres,
transforms (4, 4) lists of rows, pixel centres integers.

| field | is |
|---|---|
| ``intrinsics`` | ``width_px``, ``height_px``, ``fx_px``, ``fy_px``, ``cx_px``, ``cy_px`` |
| ``distortion`` | OpenCV's coefficients in its order, k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty: 0, 4, 5, 8, 12 or 14 |
| ``date``, ``method`` | when (ISO 8601), and how |
| ``residuals`` | figures of the fit by name, the unit in the name |
| ``covariance`` | ``parameters``, names, and ``matrix`` over them |
| ``T_board_cam``, ``T_base_board`` | the camera on the board, the board at the robot's base |
| ``gripper_counts`` | encoder counts by name, such as ``open`` and ``closed`` |
| ``robot_serial``, ``camera_serial`` | whose calibration it is |
"""

from __future__ import annotations

import datetime
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cad.files import write_json
from cad.spatial import BASLER, Array, Intrinsics
from perception.estimates import PerceptionError
from perception.opencv_camera import camera_of_opencv

FORMAT, VERSION = "tagcell-calibration", 1
NOMINAL = "nominal"
"""Instead of a file: the camera as its data sheet and lens describe it."""
COEFFICIENTS = (0, 4, 5, 8, 12, 14)
SAME_ASPECT_PX = 1.0
"""A photograph is a scaled one when its height is within this of what the calibration's aspect makes of its width."""
FIELDS = (
    "intrinsics",
    "distortion",
    "date",
    "method",
    "residuals",
    "covariance",
    "T_board_cam",
    "T_base_board",
    "gripper_counts",
    "robot_serial",
    "camera_serial",
)
PIXELS = ("width", "height", "fx", "fy", "cx", "cy")


class CalibrationError(PerceptionError):
    """A calibration that is missing, damaged, incomplete, or of another camera; the message names file and field."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Covariance:
    """Of calibrated ``parameters``, names whose units the method's documentation tells: ``matrix`` (N, N)."""

    parameters: tuple[str, ...]
    matrix: Array

    def __post_init__(self) -> None:
        n = len(self.parameters)
        if self.matrix.shape != (n, n) or len(set(self.parameters)) != n:
            raise CalibrationError(f"covariance {self.matrix.shape} of {n} parameters: one row and column a parameter")
        scale = np.sqrt(np.abs(np.diag(self.matrix))) + 1e-300
        correlation = self.matrix / scale / scale[:, None]
        if not np.isfinite(self.matrix).all() or np.abs(correlation - correlation.T).max(initial=0.0) > 1e-6:
            raise CalibrationError("covariance must be finite and symmetric")
        if n and np.linalg.eigvalsh(correlation).min() < -1e-6:
            raise CalibrationError("covariance must have no negative eigenvalue")


@dataclass(frozen=True, kw_only=True, eq=False)
class CellCalibration:
    """See the module's text; ``None`` and empty stand for what was not calibrated."""

    intrinsics: Intrinsics
    distortion: tuple[float, ...] = ()
    date: str | None = None
    method: str | None = None
    residuals: dict[str, float] = field(default_factory=dict)
    covariance: Covariance | None = None
    T_board_cam: Array | None = None
    T_base_board: Array | None = None
    gripper_counts: dict[str, int] = field(default_factory=dict)
    robot_serial: str | None = None
    camera_serial: str | None = None

    def __post_init__(self) -> None:
        if len(self.distortion) not in COEFFICIENTS or not np.isfinite(self.distortion).all():
            raise CalibrationError(
                f"distortion {list(self.distortion)}: it must be finite and have 0, 4, 5, 8, 12 or 14 coefficients, "
                "OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty"
            )
        if self.date is not None:
            try:
                datetime.datetime.fromisoformat(self.date)
            except ValueError as error:
                raise CalibrationError(
                    f"date {self.date!r}: write it as ISO 8601, 2026-01-31T12:00:00+00:00"
                ) from error
        for name in ("T_board_cam", "T_base_board"):
            T = getattr(self, name)
            if T is not None and not _rigid(T):
                raise CalibrationError(f"{name} is no rigid transform: (4, 4), a rotation and metres, last row 0 0 0 1")
        if not all(np.isfinite(value) for value in self.residuals.values()):
            raise CalibrationError(f"residuals {self.residuals}: all must be finite")

    @classmethod
    def nominal(cls) -> CellCalibration:
        """The Basler acA5472-17uc behind a 25 mm lens without distortion, as the simulated cell has it."""
        return cls(intrinsics=BASLER, method="nominal")

    @classmethod
    def load(cls, path: Path | str) -> CellCalibration:
        """Read ``calibration.json``, a camera file of OpenCV or ROS (YAML or JSON), or make the "nominal" one.

        Raises CalibrationError naming the file and what is wrong with it.
        """
        if str(path) == NOMINAL:
            return cls.nominal()
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else "it is no text"
            raise CalibrationError(
                f"calibration {path} cannot be read: {why}; name a calibration.json, a camera file of OpenCV, or "
                f"`{NOMINAL}` for the Basler as its data sheet has it"
            ) from error
        try:
            return _parsed(text)
        except PerceptionError as error:
            raise CalibrationError(f"calibration {path}: {error}") from error

    def save(self, path: Path) -> None:
        """Write as JSON; a reader never sees half a file."""
        k = self.intrinsics
        content: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "date": self.date,
            "method": self.method,
            "intrinsics": {f"{name}_px": getattr(k, name) for name in PIXELS},
            "distortion": [float(value) for value in self.distortion],
            "residuals": self.residuals,
            "covariance": self.covariance
            and {"parameters": list(self.covariance.parameters), "matrix": self.covariance.matrix.tolist()},
            "T_board_cam": None if self.T_board_cam is None else self.T_board_cam.tolist(),
            "T_base_board": None if self.T_base_board is None else self.T_base_board.tolist(),
            "gripper_counts": self.gripper_counts,
            "robot_serial": self.robot_serial,
            "camera_serial": self.camera_serial,
        }
        write_json(path, {name: value for name, value in content.items() if value not in (None, {}, [])})

    def intrinsics_of(self, width: int, height: int, offset: tuple[int, int] | None = None) -> Intrinsics:
        """Intrinsics of a photograph of ``width`` x ``height`` pixels.

        With ``offset`` it is the window of the calibrated frame that starts at that pixel (u, v). Without, it has the
        calibration's size, or shows the whole frame reduced or enlarged. Raises CalibrationError when it does not.
        """
        k = self.intrinsics
        if offset is not None:
            u, v = offset
            if u < 0 or v < 0 or u + width > k.width or v + height > k.height:
                raise CalibrationError(
                    f"a window of {width} x {height} pixels at {u}, {v} reaches out of the calibrated frame of "
                    f"{k.width} x {k.height}"
                )
            return k.crop(u, v, width, height)
        if (width, height) == (k.width, k.height):
            return k
        if abs(height - width * k.height / k.width) <= SAME_ASPECT_PX:
            return k.resampled(width, height)
        turned = abs(width - height * k.height / k.width) <= SAME_ASPECT_PX
        remedy = (
            "it lies on its side: turn it back, the calibration is of the sensor"
            if turned
            else "give its first pixel with --offset when it is a window of the sensor, or calibrate at its size"
        )
        raise CalibrationError(
            f"the photograph has {width} x {height} pixels and the calibration is of {k.width} x {k.height}, which is "
            f"not the same shape; {remedy}"
        )


def _parsed(text: str) -> CellCalibration:
    try:
        content = json.loads(text)
    except json.JSONDecodeError:
        content = None
    if not isinstance(content, dict) or "format" not in content:
        intrinsics, distortion, error_px = camera_of_opencv(text)
        residuals = {} if error_px is None else {"rms_px": error_px}
        return CellCalibration(intrinsics=intrinsics, distortion=distortion, method="OpenCV", residuals=residuals)
    if content["format"] != FORMAT:
        raise CalibrationError(f"its format is {content['format']!r}, not {FORMAT!r}")
    if content.get("version") != VERSION:
        raise CalibrationError(f"its version is {content.get('version')!r}; this Tagcell reads version {VERSION}")
    unknown = sorted(set(content) - {"format", "version", *FIELDS})
    if unknown:
        raise CalibrationError(f"it has the unknown field {', '.join(unknown)}; fields are {', '.join(FIELDS)}")
    if content.get("intrinsics") is None:
        raise CalibrationError(f"it has no intrinsics: {', '.join(f'{name}_px' for name in PIXELS)}")
    values = {name: content[name] for name in FIELDS if content.get(name) is not None}
    try:
        return _from_values(values)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CalibrationError(f"a field has another form than it must have ({error!r})") from error


def _from_values(values: dict[str, Any]) -> CellCalibration:
    size = values["intrinsics"]
    if set(size) != {f"{name}_px" for name in PIXELS}:
        raise CalibrationError(f"intrinsics are {sorted(size)}; they must be {[f'{name}_px' for name in PIXELS]}")
    numbers: dict[str, Any] = {name: float(size[f"{name}_px"]) for name in PIXELS}
    if not np.isfinite(list(numbers.values())).all() or numbers["width"] % 1 or numbers["height"] % 1:
        raise CalibrationError(f"intrinsics {size}: all must be finite, width and height whole numbers")
    width, height = int(numbers.pop("width")), int(numbers.pop("height"))
    intrinsics = Intrinsics(width=width, height=height, **numbers)
    made: dict[str, Any] = values | {"intrinsics": intrinsics}
    if "distortion" in made:
        made["distortion"] = tuple(float(value) for value in made["distortion"])
    if "covariance" in made:
        stored = made["covariance"]
        made["covariance"] = Covariance(
            parameters=tuple(stored["parameters"]), matrix=np.array(stored["matrix"], np.float64)
        )
    for name in ("T_board_cam", "T_base_board"):
        if name in made:
            made[name] = np.array(made[name], np.float64)
    if "residuals" in made:
        made["residuals"] = {str(name): float(value) for name, value in made["residuals"].items()}
    if "gripper_counts" in made:
        made["gripper_counts"] = {str(name): int(value) for name, value in made["gripper_counts"].items()}
    return CellCalibration(**made)


def _rigid(T: Array) -> bool:
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0)
