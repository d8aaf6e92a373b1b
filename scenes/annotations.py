"""The labels of one image: where each part is, which pixels show it and which would if nothing hid it.

The whole silhouette is the visible one unless the image's border cuts the part or the outline of another object crosses
its own. Only then is the part drawn alone, in a window round it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from cad.spatial import Array, Intrinsics, apply, inverse, transform
from scenes.bop import Annotation
from scenes.gl import mujoco
from scenes.lens import STRAIGHT, Lens
from scenes.render import HIDDEN_GROUP, Rendering
from scenes.shots import Shot
from scenes.stage import Stage

KEYPOINT_DEPTH_M = 1e-4
"""A keypoint is seen unless what is seen there is nearer by more: half the thinnest sheet that parts are made of."""
_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)


class Labeller:
    """Labels what is shown on a stage."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._hulls: dict[int, Array] = {}

    def label(self, shot: Shot, instances: NDArray[np.int16], drawn: Rendering) -> list[Annotation]:
        """Labels of the parts of ``shot``, as arranged, in the shot's order, without those wholly beyond the image.

        ``drawn`` holds instances and depth of the image; ``instances`` (N,) are the parts' indices in it.
        """
        assert drawn.instances is not None and drawn.depth_m is not None
        T_cam_board, camera = inverse(shot.T_board_cam), shot.intrinsics
        outlines = {geom: self._outline(geom, T_cam_board, camera) for geom in self._stage.shown}
        annotations = []
        for placed, instance in zip(shot.parts, instances.tolist(), strict=True):
            geom = self._stage.model.geom(f"part_{instance:02d}_visual").id
            found = self._windows(geom, instance, outlines, camera, drawn.instances)
            if found is None:
                continue
            corner, silhouette, visible = found
            part, T_cam_part = self._stage.part(placed.name), T_cam_board @ placed.T_board_object
            keypoints = apply(T_cam_part, part.keypoints)
            annotations.append(
                Annotation(
                    obj_id=part.obj_id,
                    stable_pose=placed.stable_pose,
                    T_cam_part=T_cam_part,
                    corner=corner,
                    silhouette=silhouette,
                    visible=visible,
                    keypoints=seen_keypoints(keypoints, camera, drawn.depth_m, self._stage.lens),
                )
            )
        return annotations

    def _windows(
        self,
        geom: int,
        instance: int,
        outlines: dict[int, NDArray[np.float32]],
        camera: Intrinsics,
        seen: NDArray[np.int16],
    ) -> tuple[tuple[int, int], NDArray[np.bool_], NDArray[np.bool_]] | None:
        """Corner, silhouette and visible pixels of one part, None when all of it is beyond the image."""
        outline = outlines[geom]
        reach = 0 if self._stage.lens.straight else 1  # a distorted outline bends, and its pixels are the nearest ones
        low = np.floor(outline.min(axis=0)).astype(int) - reach
        high = np.ceil(outline.max(axis=0)).astype(int) + 1 + reach
        size = np.array([camera.width, camera.height])
        if (high <= 0).any() or (low >= size).any():
            return None
        first, last = np.maximum(low, 0), np.minimum(high, size)
        inside = seen[first[1] : last[1], first[0] : last[0]] == instance
        whole = (low >= 0).all() and (high <= size).all()
        if whole and not any(other != geom and _cross(outline, outlines[other]) for other in outlines):
            return ((int(first[0]), int(first[1])), inside, inside) if inside.any() else None
        alone = self._alone(geom, instance, camera, low, high)
        visible = np.zeros_like(alone)
        place = np.s_[first[1] - low[1] : last[1] - low[1], first[0] - low[0] : last[0] - low[0]]
        visible[place] = inside
        alone |= visible
        return ((int(low[0]), int(low[1])), alone, visible) if alone[place].any() else None

    def _alone(
        self, geom: int, instance: int, camera: Intrinsics, low: NDArray[np.int_], high: NDArray[np.int_]
    ) -> NDArray[np.bool_]:
        """The pixels [low, high) that show a part when all else is hidden, drawn in tiles no larger than the image."""
        model = self._stage.model
        groups = model.geom_group.copy()
        model.geom_group[:] = HIDDEN_GROUP
        model.geom_group[geom] = groups[geom]
        out = np.zeros((high[1] - low[1], high[0] - low[0]), bool)
        try:
            for y in range(0, out.shape[0], camera.height):
                for x in range(0, out.shape[1], camera.width):
                    tile = out[y : y + camera.height, x : x + camera.width]
                    window = camera.crop(int(low[0]) + x, int(low[1]) + y, tile.shape[1], tile.shape[0])
                    drawn = self._stage.render(window, ("instances",)).instances
                    assert drawn is not None
                    tile[:] = drawn == instance
        finally:
            model.geom_group[:] = groups
        return out

    def _outline(self, geom: int, T_cam_board: Array, camera: Intrinsics) -> NDArray[np.float32]:
        """The convex outline (N, 2) of a geom in pixels, clockwise."""
        data = self._stage.data
        T_board_geom = transform(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom])
        points = apply(T_cam_board @ T_board_geom, self._hull(geom))
        pixels = self._stage.lens.project(camera, points).astype(np.float32)
        return np.asarray(cv2.convexHull(pixels)[:, 0], np.float32)

    def _hull(self, geom: int) -> Array:
        """Corners (N, 3) of the convex hull of a geom in its own frame; those of a box round it if it is no mesh."""
        model = self._stage.model
        mesh = int(model.geom_dataid[geom])
        key = mesh if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH else -1 - geom
        if key not in self._hulls:
            if key >= 0:
                first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
                vertices = model.mesh_vert[first : first + count].astype(np.float64)
                self._hulls[key] = vertices[ConvexHull(vertices).vertices]
            else:
                self._hulls[key] = model.geom_aabb[geom, :3] + model.geom_aabb[geom, 3:] * _CORNERS
        return self._hulls[key]


def seen_keypoints(p_cam: Array, camera: Intrinsics, depth_m: NDArray[np.float32], lens: Lens = STRAIGHT) -> Array:
    """(K, 3) pixel u, v, and 2 where a keypoint (K, 3) in ``cam`` is seen, 1 where it is hidden or beyond the image.

    It is seen where the depth in one of the four pixels round it is not less than its own.
    """
    pixels = lens.project(camera, p_cam)
    height, width = depth_m.shape
    inside = ((pixels >= -0.5) & (pixels < [width - 0.5, height - 0.5])).all(axis=1)
    near = np.floor(pixels).astype(np.int64)
    columns = np.clip(near[:, :1] + np.array([0, 1, 0, 1]), 0, width - 1)
    rows = np.clip(near[:, 1:] + np.array([0, 0, 1, 1]), 0, height - 1)
    free = depth_m[rows, columns].max(axis=1) >= p_cam[:, 2] - KEYPOINT_DEPTH_M
    return np.column_stack([pixels, np.where(inside & free, 2.0, 1.0)])


def _cross(a: NDArray[np.float32], b: NDArray[np.float32]) -> bool:
    """Whether two convex outlines (N, 2) have a point in common."""
    if (a.min(axis=0) > b.max(axis=0)).any() or (b.min(axis=0) > a.max(axis=0)).any():
        return False
    return cv2.intersectConvexConvex(a, b)[0] > 0
