"""Ground truth behind the estimator's protocol: tells a fault of the arm from a fault of perception."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cad.parts import Part
from cad.resting import nearest_rest
from cad.spatial import Array, apply, inverse, transform
from perception.estimates import ACCEPTED, Frame, FrameEstimate, PartEstimate
from scenes.camera import camera_pose
from scenes.gl import mujoco
from scenes.workcell import CellConfig, part_body

LEANING_RAD = np.radians(5.0)
"""A part further than this from every stable pose leans on something and is declined."""
ABOVE_BOARD_M = 2e-3


class OracleEstimator:
    """The true pose of every part that lies on the board's free middle; the image itself is not looked at.

    ``parts[i]`` is the class of part instance i. Only entry points wire it to a controller.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, parts: Sequence[Part], cell: CellConfig | None = None
    ) -> None:
        self._model, self._data, self._parts = model, data, list(parts)
        self._cell = cell or CellConfig()
        self._bodies = [model.body(part_body(i)).id for i in range(len(self._parts))]

    def estimate(self, frame: Frame) -> FrameEstimate:
        """See :class:`perception.estimates.PoseEstimator`; reads the simulation as it is now."""
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        T_cam_world = inverse(camera_pose(self._model, self._data))
        T_board_world = inverse(self._cell.T_world_board)
        seen = []
        for part, body in zip(self._parts, self._bodies, strict=True):
            T_world_part = transform(self._data.xmat[body].reshape(3, 3), self._data.xpos[body])
            T_board_part = T_board_world @ T_world_part
            if self._on_board(part, T_board_part):
                seen.append(_true_estimate(part, T_cam_world @ T_world_part, T_board_part))
        return FrameEstimate(
            T_cam_board=T_cam_world @ self._cell.T_world_board, parts=tuple(seen), tags_seen=0, tag_rms_px=0.0
        )

    def _on_board(self, part: Part, T_board_part: Array) -> bool:
        vertices = apply(T_board_part, part.mesh.convex_hull.vertices)
        half = np.array(self._cell.tagboard.free_half_extents_m)
        inside = (np.abs(vertices[:, :2].mean(axis=0)) < half).all()
        return bool(inside and abs(vertices[:, 2].min()) < ABOVE_BOARD_M)


def _true_estimate(part: Part, T_cam_part: Array, T_board_part: Array) -> PartEstimate:
    pose, tilt = nearest_rest(part, T_board_part[:3, :3])
    leans = tilt > LEANING_RAD
    return PartEstimate(
        part=part.name,
        T_cam_part=T_cam_part,
        stable_pose=pose.index,
        score=1.0,
        verdict=f"leans {np.degrees(tilt):.1f} degrees" if leans else ACCEPTED,
    )
