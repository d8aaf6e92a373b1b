"""Photographs nobody rendered, one after the other: poses as JSON, a picture of them and, if asked for, crops.

Of a photograph ``NAME.png`` are written ``NAME.estimate.json``, ``NAME.overlay.jpg`` and ``NAME.crops/NN_PART.png``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cad.files import write_json
from cad.parts import Part
from perception.calibration import table_from_board
from perception.calibration_file import CellCalibration
from perception.crop_view import CROP_PX
from perception.estimates import Frame, FrameEstimate, PerceptionError, PoseEstimator
from perception.overlay import draw_overlay, mask_box, save_picture, with_mask
from perception.photo import LensCorrection, read_photo
from perception.photo_result import FORMAT, VERSION, photo_result
from perception.standard_view import frame_scale, standard_crop


@dataclass(frozen=True, kw_only=True)
class PhotoEstimator:
    """Estimates photographs of one camera.

    ``parts`` holds, by name, all parts that ``estimator`` may name. ``offset`` is the first pixel (u, v) of photographs
    that are a window of the calibrated frame. ``about`` is added to every result: what it was made with.
    """

    estimator: PoseEstimator
    parts: Mapping[str, Part]
    calibration: CellCalibration
    out: Path
    offset: tuple[int, int] | None = None
    export_crops: bool = False
    about: dict[str, Any] = field(default_factory=dict)

    def run(self, images: Sequence[Path]) -> Iterator[dict[str, Any]]:
        """The result of each image as soon as it is written; one that failed has ``error`` instead of ``parts``."""
        for image, name in zip(images, result_names(images), strict=True):
            result = {"format": FORMAT, "version": VERSION, "image": str(image), **self.about}
            files = {"result": self.out / f"{name}.estimate.json", "overlay": self.out / f"{name}.overlay.jpg"}
            files["overlay"].unlink(missing_ok=True)  # of an earlier run: whatever happens, it is not of this one
            try:
                result |= self._estimate(image, name, files["overlay"]) | {"overlay": str(files["overlay"])}
            except PerceptionError as error:
                result["error"] = str(error)
            write_json(files["result"], result)
            yield result | {"result": str(files["result"])}

    def _estimate(self, image: Path, name: str, overlay: Path) -> dict[str, Any]:
        pixels = read_photo(image)
        height, width = pixels.shape[:2]
        intrinsics = self.calibration.intrinsics_of(width, height, self.offset)
        lens = LensCorrection.of(intrinsics, self.calibration.distortion)
        frame = Frame(image=lens.undistorted(pixels), intrinsics=lens.pinhole, time_s=0.0)
        estimate = self.estimator.estimate(frame)
        result = photo_result(estimate, self.parts, self.calibration, lens)
        save_picture(overlay, draw_overlay(frame, estimate, self.parts))
        if self.export_crops:
            crops = self._crops(frame, estimate, self.out / f"{name}.crops")
            for part, crop in zip(result["parts"], crops, strict=True):
                part["crop"] = crop
        return result

    def _crops(self, frame: Frame, estimate: FrameEstimate, folder: Path) -> list[dict[str, Any]]:
        """Undistorted pictures of the parts at the scale that the networks work at, and their cameras."""
        for old in folder.glob("[0-9][0-9]_*.png"):
            old.unlink()
        scale = frame_scale(frame.intrinsics, table_from_board(estimate.T_cam_board))
        written = []
        for number, part in enumerate(estimate.parts):
            u, v, w, h = mask_box(with_mask(part, self.parts, frame.intrinsics), frame.intrinsics)
            centre = u + (w - 1) / 2, v + (h - 1) / 2
            crop, k = standard_crop(frame.image, frame.intrinsics, centre, CROP_PX, scale)
            path = folder / f"{number:02d}_{part.part}.png"
            save_picture(path, crop)
            camera = {"width_px": k.width, "height_px": k.height} | {
                f"{name}_px": getattr(k, name) for name in ("fx", "fy", "cx", "cy")
            }
            written.append({"file": str(path), "intrinsics": camera})
        return written


def result_names(images: Sequence[Path]) -> list[str]:
    """A name for each image: its own without the suffix, numbered where several images share it."""
    names: list[str] = []
    for image in images:
        name, number = image.stem, 2
        while name in names:
            name, number = f"{image.stem}_{number}", number + 1
        names.append(name)
    return names
