"""A cell of plain arithmetic: parts are boxes that the hand takes along or misses."""

from dataclasses import dataclass

import numpy as np

from cad.parts import planar
from cad.spatial import BASLER, Array, apply, inverse, rotation_x, rotation_z, transform
from perception.estimates import Frame, FrameEstimate, PartEstimate, PerceptionError
from scenes.workcell import CellConfig, build_arm
from twin.attempts import Calibration, ControllerConfig
from twin.controller import PickController
from twin.ik import ArmIk
from twin.robot import GripState, JointMove, LinearMove, MotionRefused, RobotError, RobotState

CELL = CellConfig()
BOARD = CELL.T_world_board
NESTS = CELL.nest_frames("main")[:4]
IK = ArmIk(build_arm(CELL).compile(), np.array(CELL.home_q))


@dataclass
class FakePart:
    part: object
    T_base_part: Array

    def lowest(self):
        return apply(self.T_base_part, self.part.mesh.vertices)[:, 2].min()


class FakeRobot:
    """Moves at once; a part between the closing pads is centred across them and follows the tool until they open."""

    def __init__(self, parts):
        self.parts, self.held, self.time_s = parts, None, 0.0
        self.q, self.opening, self.grip_state = np.array(CELL.home_q), 0.02, GripState.AT_POSITION
        self.misses, self.drop_on_carry, self.stuck, self.refuse = 0, 0, False, False
        self.carry_heights, self.moves = [], []

    @property
    def T_base_tcp(self):
        return IK.forward(self.q)

    def observe(self):
        return RobotState(
            time_s=self.time_s,
            q=self.q,
            qd=np.zeros(6),
            T_base_tcp=self.T_base_tcp,
            opening_m=self.opening,
            grip=self.grip_state,
        )

    def move_j(self, q, *, speed, acceleration):
        if self.held and self.drop_on_carry:
            self.drop_on_carry -= 1
            self.held, self.opening, self.grip_state = None, 0.0, GripState.AT_POSITION
        if self.held:
            self.carry_heights.append(self.held.lowest() - BOARD[2, 3])
        self._go(q)
        return JointMove(q=q, speed=speed, acceleration=acceleration, duration_s=1.0)

    def move_l(self, T_base_tcp, *, speed, acceleration):
        if self.refuse:
            raise MotionRefused("refused for the test")
        if self.stuck:
            raise RobotError("protective stop")
        self._go(IK.solve(T_base_tcp, self.q))
        return LinearMove(T_base_tcp=T_base_tcp, speed=speed, acceleration=acceleration, duration_s=1.0)

    def _go(self, q):
        before = self.T_base_tcp
        self.q, self.time_s = np.array(q), self.time_s + 1.0
        if self.held:
            self.held.T_base_part = self.T_base_tcp @ inverse(before) @ self.held.T_base_part
        self.moves.append(self.T_base_tcp)
        assert self.T_base_tcp[2, 3] > BOARD[2, 3]

    def grip(self, opening_m, *, force_n, speed):
        self.time_s += 0.3
        if self.held and opening_m > self.opening:
            T = self.held.T_base_part
            floor = BOARD[2, 3] if T[1, 3] < 0.15 else CELL.T_world_tray[2, 3]
            assert self.held.lowest() - floor < 0.3e-3, "let go too high"
            T[2, 3] += floor - self.held.lowest()
            self.held = None
        target, self.grip_state = opening_m, GripState.AT_POSITION
        if opening_m < self.opening and (found := self._between()):
            part, across = found
            if self.misses:
                self.misses -= 1
            elif np.ptp(across) > opening_m:
                centred = transform(t=-self.T_base_tcp[:3, 0] * (across.min() + across.max()) / 2)
                part.T_base_part = centred @ part.T_base_part
                self.held, target, self.grip_state = part, np.ptp(across), GripState.CONTACT_CLOSING
        self.opening = target
        return self.observe()

    def _between(self):
        for part in self.parts:
            p = apply(inverse(self.T_base_tcp) @ part.T_base_part, part.part.mesh.vertices)
            if np.abs(p[:, 0]).max() < self.opening / 2 and abs(p[:, 1].mean()) < 3e-3 and p[:, 2].min() < 0:
                return part, p[:, 0]
        return None

    def stop(self):
        pass


class FakeCamera:
    def __init__(self, robot):
        self.robot, self.exposures = robot, []

    def capture(self, exposure=1.0):
        self.robot.time_s += 1.0
        self.exposures.append(exposure)
        return Frame(image=np.zeros((1, 1, 3), np.uint8), intrinsics=BASLER, time_s=self.robot.time_s)


class FakeEstimator:
    """The truth of the parts on the board, as seen by a camera; ``change`` alters or drops an estimate."""

    T_cam_board = inverse(transform(rotation_x(np.pi - 0.01), [0.002, -0.003, 0.70]) @ transform(rotation_z(0.03)))

    def __init__(self, parts, change=None):
        self.parts, self.change, self.failures = parts, change or (lambda estimate: estimate), 0

    def estimate(self, frame):
        if self.failures:
            self.failures -= 1
            raise PerceptionError("too dark")
        T_cam_base = self.T_cam_board @ inverse(BOARD)
        seen = [
            self.change(PartEstimate(part=p.part.name, T_cam_part=T_cam_base @ p.T_base_part, stable_pose=0, score=0.9))
            for p in self.parts
            if p.T_base_part[1, 3] < 0.15
        ]
        return FrameEstimate(
            T_cam_board=self.T_cam_board, parts=tuple(s for s in seen if s), tags_seen=20, tag_rms_px=0.1
        )


PLACES = ((0.03, 0.01, 0.4), (-0.04, -0.02, 2.0), (0.0, 0.03, -1.0))


class World:
    """A robot, a camera and an estimator around boxes lying at ``places`` on the board."""

    def __init__(self, part, places=PLACES, change=None, second_look=None, **config):
        resting = part.stable_poses[0].T_table_part
        self.part, self.events = part, []
        self.parts = [FakePart(part, BOARD @ planar(*place) @ resting) for place in places]
        self.robot = FakeRobot(self.parts)
        self.estimator = FakeEstimator(self.parts, change)
        self.camera = FakeCamera(self.robot)
        self.controller = PickController(
            self.robot,
            self.camera,
            self.estimator,
            ik=IK,
            parts={"brick": part},
            calibration=Calibration(
                T_base_board=BOARD,
                T_base_nests={"brick": NESTS},
                q_park=np.array(CELL.home_q),
                board_half_m=(0.08, 0.05),
            ),
            config=ControllerConfig(**config),
            second_look=second_look,
            on_event=self.events.append,
        )

    def run(self):
        return self.controller.run()

    def in_nests(self):
        """For each nest the parts that lie right in it."""
        target = NESTS @ self.part.stable_poses[0].T_table_part
        return [[p for p in self.parts if np.allclose(p.T_base_part, T, atol=1e-5)] for T in target]
