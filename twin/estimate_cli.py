"""``tagcell estimate``: poses of the parts in photographs."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from cad.parts import hash_file, load_part
from perception.calibration_file import CellCalibration
from twin.robot import TwinError
from twin.scorecard import check_writable


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimate the poses of the parts in photographs: JPEG, PNG or TIFF, 8 or 16 bit, gray or colour.

    Writes OUT/NAME.estimate.json and OUT/NAME.overlay.jpg for each. The board's tags must be in view. EXIF orientation
    is ignored: a calibration is of the sensor's rows and columns.
    """

    images: Annotated[Positional[tuple[Path, ...]], arg(metavar="IMAGE...", help_behavior_hint="")]
    """The photographs."""
    calibration: Annotated[str, arg(metavar="FILE")]
    """The camera's calibration.json, a camera file of OpenCV or ROS (YAML or JSON), or `nominal` for the Basler behind
    25 mm without distortion."""
    offset: Annotated[tuple[int, int] | None, arg(metavar="U V", help_behavior_hint="")] = None
    """First pixel of the photographs where they are a window of the calibrated sensor."""
    parts: Annotated[tuple[str, ...], arg(metavar="NAME", help_behavior_hint="(default: all that weights know)")] = ()
    """Part classes that may be there; an estimate of another one is not accepted."""
    parts_dir: Path | None = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    weights: Path | None = None
    """Folder of trained weights; the ones that come with Tagcell when left out."""
    export_crops: bool = False
    """Save an undistorted picture of each part, too, as the networks see it: OUT/NAME.crops/NN_PART.png."""
    out: Path = Path("runs/estimate")
    """Folder for the results."""
    json: bool = False
    """Print all results as one JSON list."""

    def run(self) -> None:
        """Estimate all images; raises TwinError at the end when any of them failed."""
        if not self.images:
            raise TwinError("no photograph is given; name one or more image files")
        calibration = CellCalibration.load(self.calibration)
        check_writable(self.out)
        results = []
        for result in self._estimator(calibration).run(self.images):
            results.append(result)
            if not self.json:
                _print(result)
            elif "error" in result:
                print(f"tagcell: {result['image']}: {result['error']}", file=sys.stderr)
        if self.json:
            print(json.dumps(results, indent=1))
        failed = sum("error" in result for result in results)
        if failed:
            raise TwinError(f"{failed} of {len(results)} photographs could not be estimated; the reasons are above")

    def _estimator(self, calibration: CellCalibration) -> Any:
        """The networks with all that a result says about them."""
        from perception.estimator import WEIGHTS, LearnedEstimator
        from perception.photo_estimate import PhotoEstimator

        estimator = LearnedEstimator(self.weights, part_names=self.parts or None, parts_dir=self.parts_dir)
        known = [part.name for part in estimator.solver.nets.table.parts]
        folder = self.weights or WEIGHTS
        about = {
            "calibration": {
                "file": self.calibration,
                "date": calibration.date,
                "method": calibration.method,
                "camera_serial": calibration.camera_serial,
            },
            "weights": {path.name: hash_file(path) for path in sorted(folder.glob("*.safetensors"))},
        }
        return PhotoEstimator(
            estimator=estimator,
            parts={name: load_part(name, self.parts_dir) for name in known},
            calibration=calibration,
            out=self.out,
            offset=self.offset,
            export_crops=self.export_crops,
            about=about,
        )


def _print(result: dict[str, Any]) -> None:
    """One photograph for people."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console()
    if "error" in result:
        console.print(f"{result['image']}: {result['error']}", style="red", soft_wrap=True, markup=False)
        return
    tags = f"{result['tags_seen']} tags, {result['tag_rms_px']:.3f} px rms"
    console.print(f"{result['image']}: {tags}", soft_wrap=True, markup=False)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("", "part", "face", "x mm", "y mm", "+- mm", "yaw deg", "+- deg", "score", "verdict"):
        table.add_column(name, justify="left" if name in ("part", "verdict") else "right", no_wrap=True)
    for number, part in enumerate(result["parts"]):
        sigma = part["sigma"]
        table.add_row(
            str(number),
            part["part"],
            str(part["stable_pose"]),
            f"{part['x_board_mm']:.3f}",
            f"{part['y_board_mm']:.3f}",
            f"{max(sigma['x_board_mm'], sigma['y_board_mm']):.3f}",
            f"{part['yaw_board_deg']:.2f}",
            f"{sigma['yaw_deg']:.2f}",
            f"{part['score']:.2f}",
            part["verdict"],
        )
    console.print(table)
    if "moved_since_calibration" in result:
        moved = result["moved_since_calibration"]
        console.print(
            f"the camera is {moved['distance_mm']:.2f} mm, {moved['angle_deg']:.3f} degrees from where it was"
        )
    console.print(result["result"], soft_wrap=True, markup=False)
    console.print(result["overlay"], soft_wrap=True, markup=False)
