"""The camera in simulation: the whole 20 MP frame, rendered and exposed with sensor noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cad.spatial import BASLER, Intrinsics
from perception.estimates import Frame
from scenes.gl import mujoco
from scenes.render import Renderer
from scenes.sensor import SensorConfig, expose


class SimCamera:
    """Implements :class:`twin.robot.Camera` on a compiled cell; the robot holds still while it looks.

    Every capture lets ``latency_s`` of simulated time pass after the exposure: readout, transfer and the time that a
    real estimator would take on the frame. Noise comes from ``rng``; a frame is stamped with the simulated time of
    its exposure. Without a ``renderer`` frames stay black, for an estimator that never looks at them.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        renderer: Renderer | None,
        *,
        rng: np.random.Generator,
        intrinsics: Intrinsics = BASLER,
        sensor: SensorConfig | None = None,
        latency_s: float = 1.0,
    ) -> None:
        if not (np.isfinite(latency_s) and latency_s >= 0):
            raise ValueError(f"latency_s {latency_s} must be finite and not negative")
        self._model, self._data, self._renderer, self._rng = model, data, renderer, rng
        self._intrinsics, self._sensor, self._latency_s = intrinsics, sensor or SensorConfig(), latency_s

    def capture(self) -> Frame:
        """See :class:`twin.robot.Camera`."""
        mujoco.mj_forward(self._model, self._data)
        frame = Frame(image=self._image(), intrinsics=self._intrinsics, time_s=float(self._data.time))
        steps = round(self._latency_s / self._model.opt.timestep)
        if steps:
            mujoco.mj_step(self._model, self._data, steps)
        return frame

    def _image(self) -> NDArray[np.uint8]:
        if self._renderer is None:
            return np.zeros((self._intrinsics.height, self._intrinsics.width, 3), np.uint8)
        ideal = self._renderer.render(self._data, self._intrinsics, ("rgb",)).rgb
        assert ideal is not None
        return expose(ideal, self._sensor, self._rng)
