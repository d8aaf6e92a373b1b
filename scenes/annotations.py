"""The labels of one image: where each part is, which pixels show it and which would if nothing hid it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cad.spatial import inverse
from scenes.bop import Annotation, annotation_box
from scenes.render import Rendering
from scenes.shots import Shot
from scenes.stage import Stage


def annotate(stage: Stage, shot: Shot, instances: NDArray[np.int16], drawn: Rendering) -> list[Annotation]:
    """Labels of the parts of ``shot``, as arranged on ``stage``, in the shot's order.

    ``instances`` (N,) are the parts' indices in ``drawn.instances``.
    """
    assert drawn.instances is not None
    seen = drawn.instances
    border = np.concatenate([seen[0], seen[-1], seen[:, 0], seen[:, -1]])
    margin = int(np.ceil(160 / shot.downscale))
    wide = None
    if (border >= 0).any():
        window = shot.intrinsics.crop(-margin, -margin, seen.shape[1] + 2 * margin, seen.shape[0] + 2 * margin)
        wide = stage.render(window, ("instances",)).instances
    T_cam_board = inverse(shot.T_board_cam)
    annotations = []
    for placed, instance in zip(shot.parts, instances, strict=True):
        mask = seen == instance
        if not mask.any():
            continue
        full = mask if wide is None else wide == instance
        x, y, w, h = annotation_box(full)
        shift = 0 if wide is None else margin
        annotations.append(
            Annotation(
                obj_id=stage.part(placed.name).obj_id,
                stable_pose=placed.stable_pose,
                T_cam_part=T_cam_board @ placed.T_board_object,
                mask=mask,
                full_count=int(full.sum()),
                full_box=(x - shift, y - shift, w, h),
            )
        )
    return annotations
