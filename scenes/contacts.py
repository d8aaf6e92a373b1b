"""Contact parameters for parts of a few millimetres and 0.3 g, and who may touch whom.

MuJoCo's default contacts are meant for bodies of kilograms: at this scale parts rest 0.1 to 0.2 mm deep in the table
and a grip of 20 N passes through them. ``benchmarks/contact.py`` measures what the values here do to a part;
``margin`` stays 0 because it would float a part above the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

from cad.gripper import PAD_FRICTION
from cad.primitives import Primitive
from cad.spatial import quat_wxyz_from_rotation
from scenes.gl import mujoco
from scenes.render import COLLISION_GROUP

BOX = mujoco.mjtGeom.mjGEOM_BOX.value
PLANE = mujoco.mjtGeom.mjGEOM_PLANE.value
_TYPES = {
    "box": BOX,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE.value,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER.value,
}


class Touches(IntFlag):
    """Collision groups as bits of ``contype`` and ``conaffinity``.

    The board is there twice: as the ``PLATE`` that the robot meets, and as the ``LEVEL`` that parts lie on, an endless
    plane at its top. On a box parts creep by up to 0.2 um/s and rock: where a facet of a part is almost parallel to the
    box MuJoCo takes the contact's normal from the facet. A plane's normal is its own.
    """

    NOTHING = 0
    CELL = 1
    PART = 2
    ROBOT = 4
    PLATE = 8
    LEVEL = 16


@dataclass(frozen=True, kw_only=True)
class Contact:
    """MuJoCo's contact parameters of one kind of surface.

    ``friction`` is sliding (no unit), torsional (m) and rolling (m); ``dimensions`` of 4 leave rolling free, 6 do not.
    """

    friction: tuple[float, float, float]
    dimensions: int
    solref: tuple[float, float]
    solimp: tuple[float, float, float, float, float]
    priority: int = 0


PART = Contact(friction=(0.4, 5e-4, 2e-5), dimensions=6, solref=(0.004, 1.0), solimp=(0.95, 0.99, 1e-4, 0.5, 2.0))
"""Parts, and the board and tray they lie on, up to 4 um deep: dry steel on painted plate. Without rolling friction a
screw on its side rolls for seconds; with 5e-5 m of it 0.7 % of dropped screws stay balanced on the head's edge."""
ROBOT = Contact(friction=(0.4, 5e-4, 5e-5), dimensions=4, solref=(0.004, 1.0), solimp=(0.95, 0.99, 1e-4, 0.5, 2.0))
"""Arm and hand housings: they should never touch anything, and are as stiff as the parts when they do."""


def pad_contact(timestep_s: float) -> Contact:
    """The gripper's pads, which decide alone (priority 1): as stiff as the time step allows.

    A time constant of two steps is the shortest MuJoCo accepts, but fingers that close on a box askew by half a degree
    then throw it up by a millimetre; from 2.35 steps on nothing is thrown. Slip in the hand grows with it: parts are
    placed within 22, 31 and 41 um (mean) at 2, 2.5 and 3 steps. With (0.9, 0.95, 1e-3) for the
    impedance a part of 0.3 g is squeezed out or passed through at 20 N; with these 0.1 g are squeezed by 17 um.
    Torsional friction keeps a part held between two points from turning.
    """
    return Contact(
        friction=(PAD_FRICTION, 0.003, 1e-4),
        dimensions=4,
        solref=(2.5 * timestep_s, 1.0),
        solimp=(0.999, 0.9999, 1e-5, 0.5, 2.0),
        priority=1,
    )


_PARTNERS = {
    Touches.CELL: Touches.PART | Touches.ROBOT,
    Touches.PART: Touches.CELL | Touches.PART | Touches.ROBOT | Touches.LEVEL,
    Touches.ROBOT: Touches.CELL | Touches.PART | Touches.PLATE,
    Touches.PLATE: Touches.ROBOT,
    Touches.LEVEL: Touches.PART,
}


def make_collision(geom: mujoco.MjsGeom, kind: Touches, contact: Contact) -> None:
    """Turn a geom into a massless collision geom of one group; it is not drawn.

    The cell's fixed parts never meet each other, nor do the links of the robot; everything else does, but for what
    :class:`Touches` says of the board.
    """
    geom.group = COLLISION_GROUP
    geom.mass = 0.0
    geom.contype, geom.conaffinity = int(kind), int(_PARTNERS[kind])
    geom.condim = contact.dimensions
    geom.friction, geom.solref, geom.solimp = contact.friction, contact.solref, contact.solimp
    geom.priority = contact.priority


def add_primitive(body: mujoco.MjsBody, solid: Primitive, kind: Touches, contact: Contact) -> None:
    """Add a collision solid from ``cad`` to the body it belongs to."""
    geom = body.add_geom(name=solid.name, type=_TYPES[solid.kind], size=[*solid.size, 0.0][:3])
    geom.pos = solid.T_body_geom[:3, 3]
    geom.quat = quat_wxyz_from_rotation(solid.T_body_geom[:3, :3])
    make_collision(geom, kind, contact)


def set_options(spec: mujoco.MjSpec, timestep_s: float) -> None:
    """Solver settings.

    A part held by facets that are not quite parallel to the pads creeps by 22 um in 5 s with an ``impratio`` of 10. It
    would creep less with more, but the solver takes longer, and pads that let go of a part drag it further: with 30
    parts end 39 um from where they should in the nest, with 10 they end 25 um from there.
    """
    spec.compiler.degree = False
    option = spec.option
    option.timestep = timestep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST.value
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC.value
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON.value
    option.impratio = 10.0
    option.tolerance = 1e-10
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP.value
