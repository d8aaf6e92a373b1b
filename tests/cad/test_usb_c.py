"""Collected only where the CAD kernel is installed (see conftest.py)."""

from itertools import combinations

import numpy as np
import pytest
from build123d import Pos

from cad.models import build, usb_c
from cad.parts import LIBRARY, load_part


@pytest.fixture(scope="module")
def assembly():
    return usb_c.assembly()


@pytest.mark.parametrize("name", list(usb_c.FEATURES))
def test_the_stored_mesh_is_that_of_the_solid(assembly, name):
    part, solid = load_part(name), assembly[name]
    assert part.mesh.volume * 1e9 == pytest.approx(solid.volume, rel=1e-3)
    box = solid.bounding_box()
    np.testing.assert_allclose(part.mesh.bounds * 1e3, [[*box.min], [*box.max]], atol=1e-3)


@pytest.mark.parametrize("name", list(usb_c.FEATURES))
def test_building_again_gives_the_stored_files(tmp_path, name):
    build.build_part(name, tmp_path)
    for file in ("mesh.ply", "part.json", "symmetries.json", "keypoints.json", "source.step"):
        assert (tmp_path / name / file).read_bytes() == (LIBRARY / name / file).read_bytes(), file
    hulls = sorted(p.name for p in (tmp_path / name / "hulls").iterdir())
    assert hulls == sorted(p.name for p in (LIBRARY / name / "hulls").iterdir())


@pytest.mark.parametrize("pair", list(usb_c.CLEARANCES_MM))
def test_assembled_pieces_keep_their_clearance(assembly, pair):
    a, b = (assembly[name] for name in pair)
    assert usb_c.intersection_volume_mm3(a, b) == 0.0
    assert a.distance_to(b) == pytest.approx(usb_c.CLEARANCES_MM[pair], abs=1e-6)


def test_every_pair_of_pieces_has_a_stated_clearance():
    assert {frozenset(p) for p in combinations(usb_c.FEATURES, 2)} == {frozenset(p) for p in usb_c.CLEARANCES_MM}


@pytest.mark.parametrize("shift_mm", [-8.0, -4.0, -2.0, -1.0, -0.5])
def test_the_moulding_slides_into_the_shell_from_the_rear(assembly, shift_mm):
    assert usb_c.intersection_volume_mm3(Pos(shift_mm, 0, 0) * assembly["inserted"], assembly["main"]) == 0.0


@pytest.mark.parametrize("shift_mm", [4.0, 1.0, 0.3])
def test_the_cover_goes_on_from_above(assembly, shift_mm):
    lifted = Pos(0, 0, shift_mm) * assembly["top"]
    assert all(usb_c.intersection_volume_mm3(lifted, assembly[name]) == 0.0 for name in ("inserted", "main"))


def test_overlap_is_measured(assembly):
    raised = Pos(0, 0, 0.2) * assembly["inserted"]
    assert usb_c.intersection_volume_mm3(raised, assembly["main"]) > 0.1


def test_the_interface_has_the_specified_size():
    assert pytest.approx((8.34, 2.56)) == (usb_c.OPENING_WIDTH, usb_c.OPENING_HEIGHT)
    assert pytest.approx((6.69, 0.70, 0.5)) == (usb_c.TONGUE_WIDTH, usb_c.TONGUE_HEIGHT, usb_c.CONTACT_PITCH)
    assert pytest.approx((8.94, 3.16, 7.35)) == (usb_c.SHELL_WIDTH, usb_c.SHELL_HEIGHT, usb_c.SHELL_LENGTH)
    assert np.diff(usb_c.contact_ys()) == pytest.approx(np.full(11, 0.5))
