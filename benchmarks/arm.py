"""How exactly the simulated arm does what it is told: python -m benchmarks.arm.

The compiled model against the published tables and the closed form, static and tracking error of the TCP at the speeds
of scored picks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.tables import Section, show
from cad import robot
from cad.robot_calibration import read_dh_calibration
from cad.spatial import Array, apply, rotation_angle, transform
from scenes.arm import FORCE_NUMERIC, GRIPPER_ACTUATOR, SPEED_NUMERIC
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_arm
from twin.attempts import ControllerConfig
from twin.profiles import JointPath, LinearPath, speed_for
from twin.robot import top_down
from twin.sim_robot import SimRobot, SimRobotConfig


@dataclass(frozen=True, kw_only=True)
class ArmBenchmark:
    """Options of the benchmark."""

    seed: int = 0
    poses: int = 50
    """Poses over board and tray at which the static error is measured."""
    cycles: int = 10
    """Pick cycles over which the tracking error is measured."""
    timestep_s: float = CellConfig().timestep_s
    arm_calibration: Path | None = None
    """Factory calibration of one arm; the nominal arm when left out."""
    json: bool = False
    """Print JSON instead of tables."""


def make_robot(cell: CellConfig) -> tuple[SimRobot, mujoco.MjData]:
    """Arm and hand at home."""
    model = build_arm(cell).compile()
    data = mujoco.MjData(model)
    data.qpos[:6] = cell.home_q
    mujoco.mj_forward(model, data)
    return SimRobot(model, data, cell), data


def compiled_model(cell: CellConfig) -> list[Section]:
    """What the compiled model holds of the published tables."""
    model, rows = build_arm(cell).compile(), []
    for name, joint in zip(robot.BODY_NAMES[1:], robot.JOINT_NAMES, strict=True):
        body, (positions, speeds, torques) = model.body(name), np.degrees(model.actuator(joint).ctrlrange)
        com = ", ".join(f"{v:g}" for v in 1e3 * body.ipos)
        limits = (f"{positions[1]:.0f}", f"{speeds[1]:.0f}", f"{np.radians(torques[1]):.0f}")
        rows.append((name.removeprefix("ur5e_"), f"{body.mass[0]:g}", com, *limits))
    hand = model.actuator(GRIPPER_ACTUATOR).ctrlrange
    ranges = [model.numeric(name).data for name in (FORCE_NUMERIC, SPEED_NUMERIC)]
    force, speed = (
        f"{scale * low:.0f} .. {scale * high:.0f}" for scale, (low, high) in zip((1, 1e3), ranges, strict=True)
    )
    return [
        Section(
            title="Compiled arm",
            columns=("link", "mass kg", "centre of mass mm", "+- degrees", "degrees/s", "N m"),
            rows=rows,
        ),
        Section(
            title="Compiled hand",
            columns=("stroke mm", "force N", "speed mm/s"),
            rows=[(f"{1e3 * hand[0, 1]:.0f}", force, speed)],
        ),
    ]


def kinematics(cell: CellConfig, rng: np.random.Generator) -> Section:
    """Compiled model against the closed form at 1,000 joint vectors over the whole range."""
    model = build_arm(cell).compile()
    data, metres, angles = mujoco.MjData(model), [], []
    for q in rng.uniform(*robot.JOINT_RANGE_RAD, (1000, 6)):
        data.qpos[:6] = q
        mujoco.mj_kinematics(model, data)
        T, site = robot.forward_kinematics(q, cell.arm)[6], data.site("flange")
        metres.append(np.linalg.norm(site.xpos - T[:3, 3]))
        angles.append(np.abs(site.xmat.reshape(3, 3) - T[:3, :3]).max())
    off = [
        np.linalg.norm((robot.forward_kinematics(q, cell.arm) - robot.forward_kinematics(q))[6, :3, 3])
        for q in rng.uniform(-np.pi, np.pi, (1000, 6))
    ]
    return Section(
        title="Flange of the compiled model against the closed form, 1,000 joint vectors; and from the nominal arm's",
        columns=("max m", "max rad", "from nominal, mean mm", "max mm"),
        rows=[(f"{max(metres):.1e}", f"{max(angles):.1e}", f"{1e3 * np.mean(off):.3f}", f"{1e3 * max(off):.3f}")],
    )


def targets(cell: CellConfig, rng: np.random.Generator) -> tuple[Array, Array]:
    """A pose over the board and one over a nest, (4, 4) each, at grasp height and any yaw."""
    half = np.array(cell.pick_area_half_m)
    board = apply(cell.T_world_board, [*rng.uniform(-half, half), 0.002])
    nests = cell.nest_frames(cell.tray.classes[int(rng.integers(len(cell.tray.classes)))])
    nest = nests[int(rng.integers(len(nests))), :3, 3]
    over_board = top_down(board[0], board[1], board[2], rng.uniform(-np.pi / 2, np.pi / 2))
    return over_board, top_down(nest[0], nest[1], nest[2] + 0.002, rng.uniform(-np.pi / 2, np.pi / 2))


def static_error(cell: CellConfig, options: ArmBenchmark, rng: np.random.Generator) -> Section:
    """TCP of the physics against the pose asked for, at rest under gravity."""
    config = ControllerConfig()
    machine, data = make_robot(cell)
    micrometres, angles = [], []
    for i in range(options.poses):
        T = targets(cell, rng)[i % 2]
        q = machine.ik.solve(T)
        machine.move_j(q, speed=config.joint_speed, acceleration=config.joint_acceleration)
        machine.wait(0.3)
        site = data.site("tcp")
        micrometres.append(1e6 * np.linalg.norm(site.xpos - T[:3, 3]))
        angles.append(1e6 * rotation_angle(site.xmat.reshape(3, 3), T[:3, :3]))
    return Section(
        title=f"Static TCP error under gravity, {options.poses} poses over board and tray, 0.3 s after the move",
        columns=("mean um", "max um", "max urad"),
        rows=[(f"{np.mean(micrometres):.3f}", f"{max(micrometres):.3f}", f"{max(angles):.3f}")],
    )


class Tracker:
    """Runs moves and compares the arm with their profiles where each control period ends."""

    def __init__(self, cell: CellConfig) -> None:
        self.machine, self._data = make_robot(cell)
        self._period_s = SimRobotConfig().control_period_s
        self.errors: dict[str, list[tuple[float, float]]] = {}
        """By name of the move: TCP error in mm and largest joint error in urad."""
        self.peaks: dict[str, tuple[float, float]] = {}
        """By name of the move: largest share of the speed limit and of the torque limit."""

    def joint(self, name: str, q: Array, rates: tuple[float, float]) -> None:
        """To ``q`` (6,) rad at (rad/s, rad/s^2) with moveJ."""
        path = JointPath(q_start=self._data.qpos[:6].copy(), q_end=q, speed=rates[0], acceleration=rates[1])
        samples = self._run(name, lambda: self.machine.move_j(q, speed=rates[0], acceleration=rates[1]))
        self._compare(name, samples, lambda time_s, _: path.at(time_s)[0])

    def linear(self, name: str, T_base_tcp: Array, rates: tuple[float, float]) -> None:
        """To ``T_base_tcp`` (4, 4) at (m/s, m/s^2) with moveL."""
        start = self.machine.observe().T_base_tcp
        path = LinearPath(T_base_start=start, T_base_end=T_base_tcp, speed=rates[0], acceleration=rates[1])
        samples = self._run(name, lambda: self.machine.move_l(T_base_tcp, speed=rates[0], acceleration=rates[1]))
        self._compare(name, samples, lambda time_s, q: self.machine.ik.refine(path.at(time_s), q))

    def _run(self, name: str, move: Callable[[], object]) -> list[tuple[float, Array]]:
        """Times since the start and joint angles (6,) of a move, at every tenth period's end."""
        data, start_s, samples = self._data, self._data.time, []
        speed, torque = self.peaks.get(name, (0.0, 0.0))

        def step() -> None:
            nonlocal speed, torque
            speed = max(speed, float((np.abs(data.qvel[:6]) / robot.SPEED_LIMIT_RAD_S).max()))
            torque = max(torque, float((np.abs(data.qfrc_actuator[:6]) / robot.TORQUE_LIMIT_NM).max()))
            periods = (data.time - start_s) / self._period_s / 10
            if abs(periods - round(periods)) < 1e-3:
                samples.append((data.time - start_s, data.qpos[:6].copy()))

        self.machine.on_step = step
        move()
        self.peaks[name] = speed, torque
        return samples

    def _compare(self, name: str, samples: list[tuple[float, Array]], asked: Callable[[float, Array], Array]) -> None:
        for time_s, q in samples:
            q_asked = asked(time_s, q)
            apart = (self.machine.ik.forward(q) - self.machine.ik.forward(q_asked))[:3, 3]
            error = 1e3 * float(np.linalg.norm(apart)), 1e6 * float(np.abs(q - q_asked).max())
            self.errors.setdefault(name, []).append(error)


def tracking(cell: CellConfig, options: ArmBenchmark, rng: np.random.Generator) -> Section:
    """The moves of a pick cycle at the speeds of scored picks, and one at the arm's own speed limit."""
    c, tracker = ControllerConfig(), Tracker(cell)
    ik, home = tracker.machine.ik, np.array(cell.home_q)
    fast, fastest = (c.joint_speed, c.joint_acceleration), (min(robot.SPEED_LIMIT_RAD_S), c.joint_acceleration)
    down, lift = (c.linear_speed, c.linear_acceleration), (c.lift_speed, c.lift_acceleration)
    touch, carry = (c.touch_speed, c.touch_acceleration), (c.carry_speed, c.carry_acceleration)
    for _ in range(options.cycles):
        pick, place = targets(cell, rng)
        hover, near, high = (transform(t=[0.0, 0.0, z]) for z in (c.hover_m, c.touch_m, c.carry_m))
        tracker.joint("approach", ik.solve(hover @ pick), fast)
        tracker.linear("down", near @ pick, down)
        tracker.linear("touch", pick, touch)
        tracker.linear("lift", high @ pick, lift)
        q = ik.solve(high @ place)
        lead = float(np.abs(q - tracker.machine.observe().q).max())
        tracker.joint("carry", q, (min(carry[0], speed_for(lead, carry[1], c.carry_min_s)), carry[1]))
        tracker.linear("lower", near @ place, lift)
        tracker.linear("touch", place, touch)
        tracker.linear("retreat", hover @ place, down)
        tracker.joint("park", home, fast)
        tracker.joint("speed limit", ik.solve(high @ place), fastest)
        tracker.joint("speed limit", home, fastest)
    rates = {"approach": fast, "down": down, "touch": touch, "lift": lift, "carry": carry, "lower": lift}
    rates |= {"retreat": down, "park": fast, "speed limit": fastest}
    rows = []
    for name, errors in tracker.errors.items():
        rms, largest = np.sqrt(np.mean(np.square(errors), axis=0)), np.max(errors, axis=0)
        (speed, torque), (v, a) = tracker.peaks[name], rates[name]
        row = (name, f"{v:.2f}", f"{a:.2f}", f"{rms[0]:.4f}", f"{largest[0]:.4f}", f"{rms[1]:.0f}", f"{largest[1]:.0f}")
        rows.append((*row, f"{speed:.0%}", f"{torque:.0%}"))
    return Section(
        title=f"Tracking over {options.cycles} pick cycles (moveJ in rad/s, moveL in m/s); peaks as shares of limits",
        columns=("move", "speed", "accel.", "TCP rms mm", "max mm", "joint rms urad", "max urad", "speed", "torque"),
        rows=rows,
    )


def main(options: ArmBenchmark) -> None:
    """Measure and print."""
    table = read_dh_calibration(options.arm_calibration) if options.arm_calibration else robot.UR5E
    cell = CellConfig(arm=table, timestep_s=options.timestep_s)
    rng = np.random.default_rng(options.seed)
    sections = [*compiled_model(cell), kinematics(cell, rng), static_error(cell, options, rng)]
    sections.append(tracking(cell, options, rng))
    show(sections, f"time step {1e3 * options.timestep_s:g} ms, seed {options.seed}", as_json=options.json)


if __name__ == "__main__":
    main(tyro.cli(ArmBenchmark, description=__doc__))
