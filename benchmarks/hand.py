"""Whether the simulated Hand-E obeys force and speed and tells objects from nothing: python -m benchmarks.hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import tyro

from benchmarks.tables import Section, show
from cad import gripper, robot
from cad.spatial import quat_wxyz_from_rotation, transform
from scenes.arm import FINGER_JOINTS
from scenes.contacts import BOX, PART, Touches, make_collision
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_arm
from twin.sim_robot import SimRobot

BLOCK_M = 0.008
"""Width of the block that the hand grips."""


@dataclass(frozen=True, kw_only=True)
class HandBenchmark:
    """Options of the benchmark."""

    timestep_s: float = CellConfig().timestep_s
    json: bool = False
    """Print JSON instead of tables."""


def make_robot(cell: CellConfig, *, block: bool = False, wall: bool = False) -> tuple[SimRobot, mujoco.MjData]:
    """Arm and hand at home, fingers at 20 mm; a floating block between the pads, or fixed ones outside them."""
    spec = build_arm(cell)
    T = robot.forward_kinematics(cell.home_q, cell.arm)[6] @ gripper.T_FLANGE_TCP
    solids = [("block", 0.0, BLOCK_M / 2, Touches.PART)] if block else []
    if wall:
        solids += [(f"wall_{s:+.0f}", s * 0.0225, 0.005, Touches.CELL) for s in (1.0, -1.0)]
    for name, x, half, kind in solids:
        place = T @ transform(t=[x, 0.0, -0.004])
        quat = quat_wxyz_from_rotation(T[:3, :3])
        body = spec.worldbody.add_body(name=name, pos=place[:3, 3], quat=quat, gravcomp=1.0)
        if kind is Touches.PART:
            body.add_freejoint(name=name)
        geom = body.add_geom(name=name, type=BOX, size=[half, 0.003, 0.003])
        make_collision(geom, kind, PART)
        geom.mass = 0.0003
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:6] = cell.home_q
    for name in FINGER_JOINTS:
        data.joint(name).qpos[0] = 0.010
    mujoco.mj_forward(model, data)
    return SimRobot(model, data, cell), data


def hand_force(cell: CellConfig) -> Section:
    """Normal force on each pad that squeezes a block of 0.3 g, against the command."""
    rows = []
    for force in (20.0, 40.0, 60.0, 80.0, 100.0, 130.0):
        machine, data = make_robot(cell, block=True)
        state = machine.grip(0.004, force_n=force, speed=0.030)
        sides, wrench = {"pad_left": 0.0, "pad_right": 0.0}, np.zeros(6)
        for i, contact in enumerate(data.contact):
            mujoco.mj_contactForce(data.model, data, i, wrench)
            for geom in (contact.geom1, contact.geom2):
                name = data.model.geom(geom).name
                sides[name] = sides.get(name, 0.0) + wrench[0]
        rows.append((f"{force:.0f}", f"{sides['pad_left']:.2f}", f"{sides['pad_right']:.2f}", state.grip.name))
    return Section(
        title=f"Hand: normal force on each pad round a block of {1e3 * BLOCK_M:.0f} mm",
        columns=("command N", "left N", "right N", "state"),
        rows=rows,
    )


def hand_speed(cell: CellConfig) -> Section:
    """Speed of the opening over its middle 40 mm, against the command."""
    rows = []
    for speed in (0.020, 0.050, 0.100, 0.150):
        machine, data = make_robot(cell)
        machine.grip(gripper.STROKE_M, force_n=gripper.FORCE_RANGE_N[0], speed=speed)
        measured = [_measure_speed(machine, data, end, speed) for end in (0.0, gripper.STROKE_M)]
        (closing, short), (opening, over) = measured
        row = (f"{1e3 * speed:.0f}", f"{-1e3 * closing:.2f}", f"{1e3 * opening:.2f}")
        rows.append((*row, f"{1e6 * max(abs(short), abs(over)):.0f}"))
    return Section(
        title="Hand: speed over the middle 40 mm of the stroke, opening reached at the ends",
        columns=("command mm/s", "closing mm/s", "opening mm/s", "off the end um"),
        rows=rows,
    )


def _measure_speed(machine: SimRobot, data: mujoco.MjData, end: float, speed: float) -> tuple[float, float]:
    """Speed over the middle of the stroke and how far from ``end`` the fingers come to rest, m/s and m."""
    trace = []
    machine.on_step = lambda: trace.append((data.time, data.ten_length[0]))
    reached = machine.grip(end, force_n=gripper.FORCE_RANGE_N[0], speed=speed).opening_m
    times, openings = np.array(trace).T
    middle = np.abs(openings - gripper.STROKE_M / 2) < 0.4 * gripper.STROKE_M
    return float(np.polyfit(times[middle], openings[middle], 1)[0]), reached - end


def hand_states(cell: CellConfig) -> Section:
    """What the hand reports in each situation of its object detection."""
    rows = [("closed on nothing", make_robot(cell)[0].grip(0.0, force_n=20.0, speed=0.1).grip.name)]
    machine, data = make_robot(cell, block=True)
    rows.append(("closed on a block", machine.grip(0.002, force_n=20.0, speed=0.1).grip.name))
    data.joint("block").qpos[:3] += [0.0, 0.0, 0.5]
    machine.wait(0.010)
    rows.append(("10 ms after the block is lost", machine.observe().grip.name))
    machine.wait(0.3)
    rows.append(("once the fingers have gone on", machine.observe().grip.name))
    state = make_robot(cell, wall=True)[0].grip(0.045, force_n=20.0, speed=0.1)
    rows.append(("opened against walls", state.grip.name))
    return Section(title="Hand: object detection", columns=("situation", "state"), rows=rows)


def main(options: HandBenchmark) -> None:
    """Measure and print."""
    cell = CellConfig(timestep_s=options.timestep_s)
    sections = [hand_force(cell), hand_speed(cell), hand_states(cell)]
    show(sections, f"time step {1e3 * options.timestep_s:g} ms", as_json=options.json)


if __name__ == "__main__":
    main(tyro.cli(HandBenchmark, description=__doc__))
