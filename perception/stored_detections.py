"""Detections that another program left in a file, for evaluation beside our own.

The file is JSON: whose detections they are (``method``, ``weights``), of what (``data``, the hash of the data set's
manifest), the score from which on they count (``min_score``), how long each image took (``seconds`` by image) and
``results`` in COCO's form, in the pixels of the data set's images. An image without an entry in ``seconds`` has not
been looked at.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path

from cad.files import write_json
from perception.bop_files import read_json
from perception.coco_results import CocoResult
from perception.estimates import PerceptionError

_RESULT_FIELDS = {"image_id", "category_id", "segmentation", "bbox", "score"}


@dataclass(frozen=True, kw_only=True)
class StoredDetections:
    """See the module's text. ``results`` below ``min_score`` are there for curves over all scores."""

    method: str
    weights: str
    data: str
    min_score: float
    seconds: dict[int, float]
    results: tuple[CocoResult, ...]

    def counted(self, image: int) -> list[CocoResult]:
        """The detections of an image that count."""
        return [r for r in self.results if r["image_id"] == image and r["score"] >= self.min_score]

    def check(self, manifest: str, images: Collection[int], file: Path) -> None:
        """Raise PerceptionError unless these are detections of all ``images`` of the data set of that ``manifest``."""
        if self.data != manifest:
            raise PerceptionError(
                f"{file} holds detections of the data set {self.data}, this one is {manifest}: run {self.method} on it"
            )
        missing = sorted(set(images) - set(self.seconds))
        if missing:
            raise PerceptionError(
                f"{file} lacks {len(missing)} of {len(images)} images, {missing[0]:06d} the first: start {self.method} "
                "again with the same arguments; it goes on where it was"
            )

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        write_json(path, asdict(self) | {"seconds": {str(image): s for image, s in self.seconds.items()}})


def read_detections(path: Path) -> StoredDetections:
    """The detections in a file; raises PerceptionError saying what is wrong with one that cannot be used."""
    content = read_json(path)
    names = ("method", "weights", "data", "min_score", "seconds", "results")
    lacking = [name for name in names if name not in content]
    if lacking:
        raise PerceptionError(f"{path} has no {', '.join(lacking)}; a file of detections has {', '.join(names)}")
    for k, result in enumerate(content["results"]):
        wrong = sorted(_RESULT_FIELDS ^ set(result))
        if wrong:
            raise PerceptionError(
                f"{path}: result {k} differs from COCO's form in {', '.join(wrong)}; it must have "
                f"{', '.join(sorted(_RESULT_FIELDS))}"
            )
    return StoredDetections(
        method=content["method"],
        weights=content["weights"],
        data=content["data"],
        min_score=float(content["min_score"]),
        seconds={int(image): float(s) for image, s in content["seconds"].items()},
        results=tuple(content["results"]),
    )
