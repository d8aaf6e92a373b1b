"""What a part stands on: the corners of its convex hull, in a few pieces.

On a plane nothing of a part counts but its hull. MuJoCo keeps at most four of the contacts between a pair of geoms,
though, and one hull with many corners on a flat face rocks on them by 0.2 degrees. Split into octants about the centre
of mass, the hull touches the plane all round, whatever face it lies on, at a small part of the cost of a
decomposition.
"""

from __future__ import annotations

import numpy as np
import trimesh

from cad.decompose import hull_of

_CORE = 0.5
"""Size of the core that all pieces share, relative to how deep the centre of mass lies inside the hull."""


def rest_pieces(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, ...]:
    """Convex pieces, at most eight, in the mesh's frame, whose common hull is the mesh's.

    Raises DecompositionError when the mesh spans no volume.
    """
    hull, centre = hull_of(np.asarray(mesh.vertices)), np.asarray(mesh.center_mass)
    corners = np.asarray(hull.vertices)
    depth = float(np.einsum("fi,fi->f", np.asarray(hull.triangles)[:, 0] - centre, hull.face_normals).min())
    core = centre + _CORE * depth * np.concatenate([np.eye(3), -np.eye(3)])
    octant = (corners > centre) @ [1, 2, 4]
    return tuple(hull_of(np.concatenate([corners[octant == k], core])) for k in np.unique(octant))
