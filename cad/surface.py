"""One watertight surface from the soups of a part's file: repair, union, outer surface, simplification."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import trimesh

from cad.meshes import MeshError
from cad.solids import outer_union, to_mesh, to_solid
from cad.soup import Soup, orient, weld

if TYPE_CHECKING:
    from cad.intake import IntakeConfig

_DIGITS = 9  # vertices that agree to a nanometre are one


def outer_surface(soups: Sequence[Soup], name: str, config: IntakeConfig) -> tuple[trimesh.Trimesh, int, list[str]]:
    """The outer surface of the union of all that is in the soups (metres), the number of solids, and notes."""
    shells = []
    for soup in soups:
        for shell in weld(soup, _DIGITS).components():
            oriented, _, orientable = orient(shell)
            if not (oriented.is_closed and orientable):
                raise MeshError(f"{name} is not closed")
            shells.append(oriented)
    union, filled = outer_union([to_solid(shell) for shell in shells])
    return to_mesh(union), len(shells), []
