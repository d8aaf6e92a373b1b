"""The referee: watches physics during a run and says of every part what happened to it.

It never asks the controller anything; the controller's only influence is to mark where one attempt ends and the next
begins. Rules (names and numbers): a part is *picked* when both pads held it, lowest point at least 50 mm above the
board, for 1 s of simulated time; *placed* when at rest in a nest of its class within 0.3 mm and 3 degrees (modulo its
proper symmetries, and its roll where it is round), same face down as it was picked; it *succeeded* when picked and
placed, no other part moved by more than 0.5 mm or 2 degrees in its attempts, and neither arm nor hand touched anything
but the part, the board under it and the nest. A part may be pushed before it is picked: a *nudge* is judged like an
attempt, may move and touch nothing but the first part that it touches, and leaves that presented anew, as it then lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cad.equivalence import Symmetries
from cad.parts import Part
from cad.resting import nearest_rest
from cad.spatial import Array, inverse, transform
from scenes.gl import mujoco
from scenes.workcell import CellConfig
from twin.robot_contacts import RobotContacts


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Tolerances of the definitions of success."""

    lift_m: float = 0.050
    hold_s: float = 1.0
    look_s: float = 0.004  # how often all contacts are looked at, besides every step in which their number changes
    hold_gap_s: float = 0.010  # contact may flicker this long between two solver steps without ending a hold
    place_m: float = 0.3e-3
    place_rad: float = np.radians(3.0)
    disturb_m: float = 0.5e-3
    disturb_rad: float = np.radians(2.0)
    settle_s: float = 1.0
    rest_window_s: float = 0.2  # a part that moves less than this within the window is at rest
    rest_m: float = 20e-6
    rest_rad: float = np.radians(0.2)
    beside_m: float = 0.015  # the board "under the part" reaches this far from the part's centre


@dataclass(kw_only=True)
class PartRecord:
    """What physics showed of one presented part."""

    part: str
    instance: int
    T_world_presented: Array
    stable_pose: int
    attempts: int = 0
    nudges: int = 0
    gripped: bool = False
    picked: bool = False
    placed: bool = False
    nest: int | None = None
    place_error_m: float | None = None
    place_error_rad: float | None = None
    disturbed: list[str] = field(default_factory=list)
    collisions: list[str] = field(default_factory=list)
    moved_by_others: bool = False
    hold_s: float = 0.0
    T_tcp_part: Array | None = None  # how it lay in the hand when it counted as picked

    @property
    def succeeded(self) -> bool:
        """Picked and placed, with nothing else moved or touched."""
        return self.picked and self.placed and not self.disturbed and not self.collisions


class Referee:
    """Watches one scene. Call ``watch`` after every physics step and ``begin_attempt`` before every attempt."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        config: CellConfig,
        parts: Sequence[Part],
        rules: Rules | None = None,
    ) -> None:
        """``parts[i]`` is the class of part instance ``i`` (body ``part_{i:02d}``); the parts lie at rest."""
        self._model, self._data, self._config, self._parts = model, data, config, list(parts)
        self._rules = rules or Rules()
        self._bodies = np.array([model.body(f"part_{i:02d}").id for i in range(len(parts))])
        self._tcp = model.site("tcp").id
        self._tcp_position = data.site_xpos[self._tcp]
        self._contacts = RobotContacts(model, data, self._bodies)
        self._hull = [np.array(p.mesh.convex_hull.vertices) for p in parts]
        self._reach = [float(np.linalg.norm(hull, axis=1).max()) for hull in self._hull]
        self._lifted_z = float(config.T_world_board[2, 3]) + self._rules.lift_m
        self._nests = {p.name: config.nest_frames(p.name) for p in parts}
        self.records = [self._present(i) for i in range(len(parts))]
        self._timestep_s, self._next_look_s, self._contact_count = float(model.opt.timestep), -np.inf, -1
        self._held_since = np.full(len(parts), np.nan)
        self._held_last = np.full(len(parts), -np.inf)
        self._open = self._nudging = False

    def poses(self) -> Array:
        """``T_world_part`` (N, 4, 4) of all part instances now."""
        return np.array([self._pose(i) for i in range(len(self._parts))])

    def begin_attempt(self, *, nudge: bool = False) -> None:
        """Close the attempt before, if any, and open a new one, or a ``nudge``: a push that is not meant to pick."""
        self._close_attempt()
        self._open, self._nudging = True, nudge
        self._start = self.poses()
        self._gripped: list[int] = []
        self._touched: list[int] = []  # in the order of their first touch
        self._struck: dict[str, Array] = {}
        self._lowest = (np.inf, np.zeros(3))
        self._next_look_s = -np.inf

    def watch(self) -> None:
        """Look at the contacts of the step just made: when their number has changed, and from time to time.

        Most steps change nothing and must cost nothing. A touch that comes and goes between two looks changes the
        number of contacts and is seen; a hold is judged by looks less than ``hold_gap_s`` apart.
        """
        data = self._data
        if not self._open or (data.ncon == self._contact_count and data.time < self._next_look_s):
            return
        self._contact_count, self._next_look_s = data.ncon, data.time + self._rules.look_s - 0.5 * self._timestep_s
        if self._tcp_position[2] < self._lowest[0]:
            self._lowest = (float(self._tcp_position[2]), self._tcp_position.copy())
        if not self._contacts.update():
            return
        self._touched += sorted(self._contacts.touched.difference(self._touched))
        for thing, point in self._contacts.strikes:
            self._strike(thing, point)
        for i in self._contacts.held:
            self._hold(i)

    def finish(self) -> list[PartRecord]:
        """Let the world come to rest, close the last attempt and judge where every part lies."""
        self._step(self._rules.settle_s)
        before = self.poses()
        self._step(self._rules.rest_window_s)
        self._close_attempt()
        for i, record in enumerate(self.records):
            distance, angle = Symmetries().difference(before[i], self._pose(i))
            self._judge_place(i, record, distance <= self._rules.rest_m and angle <= self._rules.rest_rad)
        return self.records

    def _step(self, seconds: float) -> None:
        for _ in range(round(seconds / self._model.opt.timestep)):
            mujoco.mj_step(self._model, self._data)
            self.watch()

    # -- during an attempt --------------------------------------------------------------------------------------

    def _hold(self, i: int) -> None:
        if i not in self._gripped:
            self._gripped.append(i)
            self.records[i].gripped = True
        if not self._is_lifted(i):
            return
        now = self._data.time
        if now - self._held_last[i] > self._rules.hold_gap_s or np.isnan(self._held_since[i]):
            self._held_since[i] = now
        self._held_last[i] = now
        record = self.records[i]
        record.hold_s = max(record.hold_s, now - self._held_since[i])
        if not record.picked and record.hold_s >= self._rules.hold_s:
            record.picked = True
            T_world_tcp = transform(self._data.site_xmat[self._tcp].reshape(3, 3), self._data.site_xpos[self._tcp])
            record.T_tcp_part = inverse(T_world_tcp) @ self._pose(i)

    def _is_lifted(self, i: int) -> bool:
        """Whether the part's lowest point is high enough; where its origin settles that, the hull is not asked."""
        body = self._bodies[i]
        height = float(self._data.xpos[body, 2]) - self._lifted_z
        if abs(height) > self._reach[i]:
            return height > 0
        return bool((self._hull[i] @ self._data.xmat[body, 6:]).min() + height >= 0)

    def _strike(self, name: str, point: Array) -> None:
        if name not in self._struck:
            self._struck[name] = np.empty((0, 3))
        if len(self._struck[name]) < 64:
            self._struck[name] = np.vstack([self._struck[name], point])

    # -- between attempts ---------------------------------------------------------------------------------------

    def _close_attempt(self) -> None:
        if not self._open:
            return
        self._open = False
        end = self.poses()
        meant = self._gripped or (self._touched if self._nudging else [])
        target = meant[0] if meant else self._nearest(self._lowest[1], self._start)
        moved = [
            i
            for i in range(len(self._parts))
            if i != target and self._has_moved(self._parts[i], self._start[i], end[i])
        ]
        for i in moved:
            self.records[i].moved_by_others = True
        if target is None:
            return
        record = self.records[target]
        if self._nudging and not self._gripped:
            record.nudges += 1
            record.T_world_presented, record.stable_pose = self._lies(target)
        else:
            record.attempts += 1
        record.disturbed += [f"part_{i:02d}" for i in moved]
        record.collisions += [f"part_{i:02d}" for i in sorted(set(self._touched) - {target})]
        record.collisions += self._forbidden(target)

    def _has_moved(self, part: Part, T_before: Array, T_after: Array) -> bool:
        distance, angle = part.symmetries.difference(T_before, T_after)
        return distance > self._rules.disturb_m or angle > self._rules.disturb_rad

    def _nearest(self, p_world: Array, poses: Array) -> int | None:
        distance = np.linalg.norm(poses[:, :2, 3] - p_world[:2], axis=1)
        i = int(distance.argmin())
        return i if distance[i] < self._rules.beside_m else None

    def _forbidden(self, target: int) -> list[str]:
        """Names of the things the robot struck, other than the board under the part and the nest."""
        out = []
        for name, points in self._struck.items():
            if name == "board":
                allowed = self._start[target][None, :2, 3]
            elif name == "tray":
                allowed = self._nests[self._parts[target].name][:, :2, 3]
            else:
                out.append(name)
                continue
            distance = np.linalg.norm(points[:, None, :2] - allowed[None], axis=-1).min(axis=1)
            if (distance > self._rules.beside_m).any():
                out.append(name)
        return out

    # -- judging ------------------------------------------------------------------------------------------------

    def _judge_place(self, i: int, record: PartRecord, at_rest: bool) -> None:
        part, T = self._parts[i], self._pose(i)
        pose = part.stable_poses[record.stable_pose]
        alike = part.rest_symmetries(pose.index)
        errors = [alike.difference(T_nest @ pose.T_table_part, T) for T_nest in self._nests[part.name]]
        n = int(np.argmin([e[0] for e in errors]))
        near = errors[n][0] < 0.02
        record.nest = n if near else None
        record.place_error_m, record.place_error_rad = errors[n] if near else (None, None)
        record.placed = bool(at_rest and errors[n][0] <= self._rules.place_m and errors[n][1] <= self._rules.place_rad)

    def _present(self, i: int) -> PartRecord:
        T, stable_pose = self._lies(i)
        return PartRecord(part=self._parts[i].name, instance=i, T_world_presented=T, stable_pose=stable_pose)

    def _lies(self, i: int) -> tuple[Array, int]:
        """``T_world_part`` (4, 4) and the index of the stable pose that it is nearest to."""
        T = self._pose(i)
        return T, nearest_rest(self._parts[i], T[:3, :3])[0].index

    def _pose(self, i: int) -> Array:
        body = self._bodies[i]
        return transform(self._data.xmat[body].reshape(3, 3).copy(), self._data.xpos[body].copy())
