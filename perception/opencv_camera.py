"""Camera files as OpenCV and ROS write them: ``camera_matrix``, ``distortion_coefficients`` and the image's size.

OpenCV's calibration sample and ``cv2.FileStorage`` write YAML or JSON with matrices as rows, cols and data; so does
ROS's ``camera_calibration``. Names are read whatever their case. Pixel centres are integers in both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from cad.spatial import Array, Intrinsics
from perception.estimates import PerceptionError

PINHOLE_MODELS = ("plumb_bob", "rational_polynomial", "opencv")
"""ROS's names of what ``distortion_coefficients`` mean; others, such as ``equidistant``, are another lens model."""
SKEW_LIMIT = 1e-6


class CameraFileError(PerceptionError):
    """A camera file that cannot be used; the message says why."""


class _Loader(yaml.SafeLoader):
    """Plain YAML and OpenCV's matrices."""


def _mapping(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _mapping)


def camera_of_opencv(text: str) -> tuple[Intrinsics, tuple[float, ...], float | None]:
    """Intrinsics, distortion coefficients and, where it is given, the reprojection error in pixels.

    Raises CameraFileError when the text is no camera file or lacks something.
    """
    lines = [line for line in text.splitlines() if not line.startswith("%YAML")]
    try:
        content = yaml.load("\n".join(lines), _Loader)
    except yaml.YAMLError as error:
        raise CameraFileError(f"it is neither JSON nor YAML ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict):
        raise CameraFileError("it is no mapping of names to values")
    values = {str(name).lower(): value for name, value in content.items()}
    model = values.get("distortion_model", "opencv")
    if model not in PINHOLE_MODELS:
        raise CameraFileError(f"its distortion_model is {model!r}; known are {', '.join(PINHOLE_MODELS)}")
    K = _matrix(values, "camera_matrix")
    if K.shape != (3, 3) or abs(K[0, 1]) > SKEW_LIMIT * K[0, 0] or not np.allclose(K[2], [0, 0, 1]):
        raise CameraFileError(f"camera_matrix {K.tolist()}: it must be fx 0 cx, 0 fy cy, 0 0 1")
    distortion = tuple(float(value) for value in _matrix(values, "distortion_coefficients").ravel())
    width, height = (_whole(values, name) for name in ("image_width", "image_height"))
    try:
        intrinsics = Intrinsics(
            width=width, height=height, fx=float(K[0, 0]), fy=float(K[1, 1]), cx=float(K[0, 2]), cy=float(K[1, 2])
        )
    except ValueError as error:
        raise CameraFileError(str(error)) from error
    error_px = values.get("avg_reprojection_error")
    return intrinsics, distortion, float(error_px) if isinstance(error_px, int | float) else None


def _matrix(values: dict[str, Any], name: str) -> Array:
    if name not in values:
        raise CameraFileError(
            f"it has no {name}; expected is a Tagcell calibration, or an OpenCV camera file with camera_matrix, "
            "distortion_coefficients, image_width and image_height"
        )
    stored = values[name]
    try:
        if isinstance(stored, dict):
            numbers = np.array(stored["data"], np.float64).reshape(int(stored["rows"]), int(stored["cols"]))
        else:
            numbers = np.array(stored, np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise CameraFileError(f"{name} is {stored!r}; it must be a matrix: rows, cols and data, or rows") from error
    if not np.isfinite(numbers).all():
        raise CameraFileError(f"{name} has entries that are not finite")
    return np.atleast_2d(numbers)


def _whole(values: dict[str, Any], name: str) -> int:
    value = values.get(name)
    if not isinstance(value, int) or value < 1:
        raise CameraFileError(f"its {name} is {value!r}; it must be the size of the calibrated images in pixels")
    return value
