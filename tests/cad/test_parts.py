import json
from itertools import combinations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from cad.collision import cut_shapes
from cad.folders import PartFacts, write_part_folder
from cad.meshes import surface_samples
from cad.parts import LIBRARY, PARTS_DIR_VARIABLE, PartError, load_part, part_names, planar
from cad.shape_error import solid_of
from cad.spatial import apply

NAMES = ["inserted", "main", "top"]
CLEARANCE_M = {("inserted", "main"): 70e-6, ("main", "top"): 50e-6, ("inserted", "top"): 50e-6}
SPACING_M = 80e-6


def facts(**changes):
    given = {
        "name": "brick",
        "obj_id": 9,
        "density_kg_m3": 1000.0,
        "material": "abs",
        "rgba": (0.5, 0.5, 0.5, 1.0),
        "metallic": 0.0,
        "roughness": 0.5,
    }
    return PartFacts(**given | changes)


def write_brick(root, size=(8e-3, 6e-3, 3e-3), **changes):
    mesh = trimesh.creation.box(size)
    write_part_folder(root / "brick", mesh, cut_shapes(mesh, [mesh]), facts(**changes))
    return root / "brick"


def test_the_built_in_parts_are_listed_by_obj_id(monkeypatch):
    monkeypatch.delenv(PARTS_DIR_VARIABLE, raising=False)
    assert part_names() == NAMES
    assert [load_part(name).obj_id for name in NAMES] == [1, 2, 3]


@pytest.mark.parametrize("name", NAMES)
def test_a_built_in_part_is_complete_and_under_a_centimetre_and_a_half(name):
    part = load_part(name)
    assert part.mesh.is_watertight
    assert part.mesh.is_winding_consistent
    assert len(part.mesh.faces) <= 6000
    assert part.mass_kg == pytest.approx(part.mesh.volume * part.info["density_kg_m3"], rel=1e-6)
    assert part.mesh.extents.max() < 10e-3
    assert 5e-3 < part.radius_m < part.diameter_m < 13e-3
    assert part.sources
    assert part.info["units"] == "m"
    assert part.stable_poses
    assert part.hulls
    for file in ("source.step", "preview.png", "symmetries.json"):
        assert (part.folder / file).stat().st_size > 0
    assert (part.folder / "preview.png").stat().st_size < 150_000


@pytest.mark.parametrize("pair", list(combinations(NAMES, 2)))
def test_the_parts_fit_together_with_their_clearances(pair):
    first, second = (load_part(name).mesh for name in pair)
    rng = np.random.default_rng(0)
    samples = [
        np.concatenate([surface_samples(m, int(m.area / SPACING_M**2), rng)[0], m.vertices]) for m in (first, second)
    ]
    gap = cKDTree(samples[0]).query(samples[1], distance_upper_bound=1e-3)[0].min()
    assert CLEARANCE_M[pair] - 1e-6 < gap < CLEARANCE_M[pair] + 15e-6
    assert (solid_of(first) ^ solid_of(second)).is_empty()


def test_an_unknown_part_is_answered_with_the_parts_there_are():
    with pytest.raises(PartError, match=r"'screw'.*inserted, main, top"):
        load_part("screw")


def test_a_users_own_part_is_found_by_argument_or_environment(tmp_path, monkeypatch):
    write_brick(tmp_path)
    part = load_part("brick", tmp_path)
    assert part.mass_kg == pytest.approx(144e-6)
    assert part.diameter_m == pytest.approx(np.sqrt(64 + 36 + 9) * 1e-3)
    assert len(part.symmetries.elements) == 4
    assert part.keypoints.shape == (8, 3)
    assert part.stable_poses == ()
    assert part.grasps == []
    assert part_names(tmp_path) == [*NAMES, "brick"]
    monkeypatch.setenv(PARTS_DIR_VARIABLE, str(tmp_path))
    assert load_part("brick") is part


def test_a_mesh_that_changed_since_or_is_missing_is_refused(tmp_path):
    folder = write_brick(tmp_path)
    other = write_brick(tmp_path / "other", (9e-3, 6e-3, 3e-3))
    (folder / "mesh.ply").write_bytes((other / "mesh.ply").read_bytes())
    with pytest.raises(PartError, match="build the part again"):
        load_part("brick", tmp_path)
    (folder / "mesh.ply").unlink()
    with pytest.raises(PartError, match=r"no mesh\.ply"):
        load_part("brick", tmp_path)


def test_writing_a_folder_again_leaves_no_old_pieces(tmp_path):
    folder = write_brick(tmp_path)
    mesh = trimesh.creation.box((8e-3, 6e-3, 3e-3))
    write_part_folder(folder, mesh, cut_shapes(mesh, [mesh] * 4), facts())
    write_part_folder(folder, mesh, cut_shapes(mesh, [mesh] * 2), facts())
    assert sorted(p.name for p in (folder / "hulls").iterdir()) == ["000.ply", "001.ply"]
    assert json.loads((folder / "part.json").read_text())["units"] == "m"


@pytest.mark.parametrize(
    "bad", [{"name": "my part"}, {"obj_id": 0}, {"density_kg_m3": 0.0}, {"roughness": 1.5}, {"rgba": (1.0, 1.0, 1.0)}]
)
def test_impossible_facts_are_refused(bad):
    with pytest.raises(ValueError, match=r"part name|obj_id|density|rgba"):
        facts(**bad)


def test_a_planar_motion_keeps_the_height_and_the_face_down():
    pose = load_part("main").stable_poses[0]
    T = planar(0.1, -0.05, 1.0) @ pose.T_table_part
    assert T[2, 3] == pytest.approx(pose.height_m)
    np.testing.assert_allclose(T[2, :3], pose.R_table_part[2])
    np.testing.assert_allclose(apply(planar(0.1, -0.05, 1.0), np.zeros(3)), [0.1, -0.05, 0])


def test_the_library_is_inside_the_package():
    assert LIBRARY.parent.name == "cad"
