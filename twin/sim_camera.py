"""The camera in simulation: the whole 20 MP frame, rendered and exposed with sensor noise."""

from __future__ import annotations

from dataclasses import replace

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
    real estimator would take on the frame; to set another exposure time than before takes ``change_s``. Noise comes
    from ``rng``; a frame is stamped with the simulated time of its exposure. Without a ``renderer`` frames stay black,
    for an estimator that never looks at them.
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
        change_s: float = 0.1,
    ) -> None:
        for name, value in (("latency_s", latency_s), ("change_s", change_s)):
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name} {value} must be finite and not negative")
        self._model, self._data, self._renderer, self._rng = model, data, renderer, rng
        self._intrinsics, self._sensor, self._latency_s = intrinsics, sensor or SensorConfig(), latency_s
        self._change_s, self._exposure = change_s, 1.0

    def capture(self, exposure: float = 1.0) -> Frame:
        """See :class:`twin.robot.Camera`. Raises SceneError for an exposure that is not positive."""
        sensor = replace(self._sensor, exposure=exposure * self._sensor.exposure)
        if exposure != self._exposure:
            self._wait(self._change_s)
            self._exposure = exposure
        mujoco.mj_forward(self._model, self._data)
        frame = Frame(image=self._image(sensor), intrinsics=self._intrinsics, time_s=float(self._data.time))
        self._wait(self._latency_s)
        return frame

    def _wait(self, duration_s: float) -> None:
        if steps := round(duration_s / self._model.opt.timestep):
            mujoco.mj_step(self._model, self._data, steps)

    def _image(self, sensor: SensorConfig) -> NDArray[np.uint8]:
        if self._renderer is None:
            return np.zeros((self._intrinsics.height, self._intrinsics.width, 3), np.uint8)
        ideal = self._renderer.render(self._data, self._intrinsics, ("rgb",)).rgb
        assert ideal is not None
        return expose(ideal, sensor, self._rng)
