"""The compiled model has the mass properties of the parts' meshes."""

import numpy as np
import pytest

from cad.parts import load_part
from cad.spatial import rotation_from_quat_wxyz
from scenes.cell_config import CellConfig
from scenes.workcell import build_board_scene, part_body

NAMES = ("inserted", "main", "top")


@pytest.fixture(scope="module")
def model():
    return build_board_scene(CellConfig(), NAMES).compile()


@pytest.mark.parametrize("index", range(len(NAMES)))
def test_mass_centre_and_inertia_are_the_mesh_s(model, index):
    part, body = load_part(NAMES[index]), model.body(part_body(index))
    mesh = part.mesh.copy()
    mesh.density = part.mass_kg / mesh.volume
    assert body.mass[0] == pytest.approx(part.mass_kg, rel=1e-6)
    np.testing.assert_allclose(body.ipos, mesh.center_mass, atol=1e-6 * part.diameter_m)
    R = rotation_from_quat_wxyz(body.iquat)
    inertia = R @ np.diag(body.inertia) @ R.T
    np.testing.assert_allclose(inertia, mesh.moment_inertia, atol=1e-6 * mesh.moment_inertia.max())
    np.testing.assert_allclose(np.sort(body.inertia), np.sort(np.linalg.eigvalsh(mesh.moment_inertia)), rtol=1e-6)
