"""The labels of a folder of images in COCO's form, as pycocotools loads it: run-length masks, boxes, keypoints.

As BOP's toolkit writes it, ``segmentation`` and ``area`` are of the visible pixels, ``bbox`` is that of the whole
silhouette within the image, and parts of which less than a tenth is visible are marked ``ignore``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cad.parts import Part
from cad.run_lengths import encode_runs
from cad.spatial import Array
from scenes.errors import SceneError

LARGEST = 1000
"""Images a folder and parts an image that the ids have room for."""
IGNORED_BELOW = 0.1


class CocoScene:
    """Collects the images and parts of one folder.

    Ids are unique over all folders of a data set: an image's is 1000 times the folder's number plus its own, a part's
    1000 times its image's plus its own plus one.
    """

    def __init__(self, scene_id: int, parts: Sequence[Part]) -> None:
        self._first = scene_id * LARGEST
        self._categories = [_category(part) for part in parts]
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []

    def add_image(self, image: int, file_name: str, shape: tuple[int, int]) -> None:
        """Image number ``image`` of the folder, of ``shape`` (H, W), in a file named relative to the folder."""
        if image >= LARGEST:
            raise SceneError(f"image {image}: BOP allows at most {LARGEST} images a folder")
        self._shape = shape
        self._images.append({"id": self._first + image, "file_name": file_name, "width": shape[1], "height": shape[0]})

    def add_part(
        self,
        image: int,
        part: int,
        *,
        obj_id: int,
        visible: NDArray[np.bool_],
        corner: tuple[int, int],
        box: tuple[int, int, int, int],
        visib_fract: float,
        keypoints: Array,
    ) -> None:
        """Part number ``part`` of the image added last; ``visible`` (h, w) are its pixels in a window at ``corner``."""
        if part >= LARGEST:
            raise SceneError(f"part {part} of image {image}: at most {LARGEST} parts an image can be written")
        image_id = self._first + image
        points = np.column_stack([keypoints[:, :2].round(3), keypoints[:, 2]])
        self._annotations.append(
            {
                "id": image_id * LARGEST + part + 1,
                "image_id": image_id,
                "gt_id": part,
                "category_id": obj_id,
                "segmentation": encode_runs(visible, corner, self._shape),
                "area": int(visible.sum()),
                "bbox": list(box),
                "iscrowd": 0,
                "ignore": visib_fract < IGNORED_BELOW,
                "visib_fract": visib_fract,
                "keypoints": points.ravel().tolist(),
                "num_keypoints": int((keypoints[:, 2] > 0).sum()),
            }
        )

    def content(self) -> dict[str, Any]:
        """What ``scene_gt_coco.json`` holds."""
        return {
            "info": {"description": "Tagcell: rendered images of small parts"},
            "licenses": [],
            "categories": self._categories,
            "images": self._images,
            "annotations": self._annotations,
        }


def merged(folders: Sequence[Path], contents: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The COCO contents of several folders of one data set as one, files named relative to the folders' parent."""
    images = [
        image | {"file_name": f"{folder.name}/{image['file_name']}"}
        for folder, content in zip(folders, contents, strict=True)
        for image in content["images"]
    ]
    annotations = [annotation for content in contents for annotation in content["annotations"]]
    return contents[0] | {"images": images, "annotations": annotations}


def _category(part: Part) -> dict[str, Any]:
    names = [f"{part.name}_{k}" for k in range(len(part.keypoints))]
    return {"id": part.obj_id, "name": part.name, "supercategory": "part", "keypoints": names, "skeleton": []}
