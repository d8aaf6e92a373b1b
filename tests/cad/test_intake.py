import os
import struct
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

import cad.step
from cad.intake import IntakeConfig, read_part
from cad.meshes import MeshError, check_mesh
from cad.nearest import Surface
from cad.parts import CadError
from cad.step import declared_unit
from cad.surface import RepairConfig

PARTS = Path(__file__).parents[2] / "examples" / "parts"
MM = "( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) );"
UNITS = {
    "m": "( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT($,.METRE.) );",
    "cm": "( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.CENTI.,.METRE.) );",
    "um": "( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MICRO.,.METRE.) );",
    "in": "( CONVERSION_BASED_UNIT('INCH',#9001) LENGTH_UNIT() NAMED_UNIT(#9002) );\n"
    "#9001 = LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),#9003);\n"
    "#9002 = DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.);\n"
    "#9003 = ( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) );",
}
METRES = {"m": 1.0, "cm": 1e-2, "um": 1e-6, "in": 25.4e-3}


@cache
def taken(name):
    return read_part(PARTS / f"{name}.step")


@cache
def clean():
    """The bracket's vertices in mm and its triangles: no symmetry, holes, a bend."""
    mesh = taken("bracket").mesh
    return 1e3 * np.array(mesh.vertices), np.array(mesh.faces)


def written(path, *pieces):
    """A PLY of meshes (vertices, faces) as they are, one after the other."""
    first = np.cumsum([0] + [len(vertices) for vertices, _ in pieces])
    vertices = np.concatenate([vertices for vertices, _ in pieces])
    faces = np.concatenate([faces + start for (_, faces), start in zip(pieces, first, strict=False)])
    trimesh.Trimesh(vertices, faces, process=False).export(path, vertex_normal=False)
    return path


def box(size=(8, 6, 3), at=(0, 0, 0)):
    mesh = trimesh.creation.box(size)
    return np.array(mesh.vertices) + at, np.array(mesh.faces)


def mirrored(piece):
    """The same box with the other diagonals."""
    vertices, faces = piece
    middle = vertices.mean(axis=0)
    return (vertices - middle) * [-1, 1, 1] + middle, faces[:, ::-1]


def same(intake, vertices, faces, *, ppm=1, um=0.01):
    """A part must have the volume and the bounding box of the clean mesh, given in mm."""
    check_mesh(intake.mesh)
    expected = trimesh.Trimesh(1e-3 * vertices, faces, process=False)
    assert intake.mesh.volume == pytest.approx(expected.volume, rel=1e-6 * ppm)
    np.testing.assert_allclose(intake.mesh.bounds, expected.bounds, atol=1e-6 * um)
    np.testing.assert_allclose(intake.size_mm, 1e3 * expected.extents, atol=1e-3 * um)


# What the files of the samples hold


@pytest.mark.parametrize(
    ("name", "solids", "size", "volume"),
    [
        ("m2_screw", 1, (3.8, 3.8, 8.0), 39.112),
        ("hex_nut", 1, (4 / np.cos(np.pi / 6), 4.0, 1.6), 17.727),
        ("pin_header", 5, (10.16, 2.54, 11.54), 75.985),
        ("bracket", 1, (8.0, 6.0, 5.0), 30.054),
    ],
)
def test_a_step_file_comes_in_metres_with_the_size_and_volume_of_its_solids(name, solids, size, volume):
    intake = taken(name)
    check_mesh(intake.mesh)
    assert (intake.solids, intake.unit, intake.origin_m) == (solids, "mm", (0, 0, 0))
    assert "file says" in intake.unit_source
    np.testing.assert_allclose(intake.size_mm, size, atol=2e-3)  # the deflection
    assert intake.mesh.volume * 1e9 == pytest.approx(volume, rel=1e-3)
    assert len(intake.mesh.split()) == 1


def test_solids_that_touch_become_one_surface_and_a_note_says_so():
    intake = taken("pin_header")
    assert any("5 solids united" in note for note in intake.notes)
    inner = intake.mesh.triangles_center[:, 2]
    pins = np.linalg.norm(intake.mesh.triangles_center[:, :2] - [1.27e-3, 0], axis=1) < 0.33e-3
    assert not (pins & (inner > 0.3e-3) & (inner < 2.2e-3)).any()  # nothing is left of the walls in the body


@pytest.mark.parametrize("unit", ["in", "um"])
def test_a_step_file_is_read_in_the_unit_it_declares(tmp_path, unit):
    path = tmp_path / "part.stp"
    path.write_bytes(declaring(unit))
    intake = read_part(path, accept_size=True)
    assert intake.unit == unit
    np.testing.assert_allclose(np.array(intake.size_mm), 1e3 * METRES[unit] * np.array([8, 6, 5]), rtol=1e-5)


def declaring(unit):
    text = (PARTS / "bracket.step").read_text()
    assert MM in text
    return text.replace(MM, UNITS[unit]).encode()


@pytest.mark.parametrize("unit", UNITS)
def test_the_unit_of_a_step_file_is_found_in_its_text(unit):
    assert declared_unit(declaring(unit)) == unit
    assert declared_unit(declaring(unit).replace(b" ", b"\n")) == unit
    assert declared_unit(b"GLOBAL_UNIT_ASSIGNED_CONTEXT((#1)); #1=(NAMED_UNIT(*)PLANE_ANGLE_UNIT());") is None


def test_a_unit_that_is_asked_for_overrules_the_one_a_step_file_declares(tmp_path):
    path = tmp_path / "part.stp"
    path.write_bytes(declaring("in"))
    intake = read_part(path, unit="mm")
    np.testing.assert_allclose(intake.size_mm, (8, 6, 5), rtol=1e-5)
    assert (intake.unit, intake.unit_source) == ("mm", "as asked (the file says in)")
    path.write_bytes((PARTS / "bracket.step").read_bytes().replace(b".METRE.", b".PARSEC."))
    assert "leave --unit away" in refusal(path, unit="in")


# Units of meshes


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "off"])
@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 1e-2), ("mm", 1e-3), ("um", 1e-6), ("in", 25.4e-3)])
def test_a_mesh_is_read_in_the_unit_it_is_said_to_be_in(tmp_path, suffix, unit, metres):
    mesh = trimesh.creation.box(np.array([8e-3, 6e-3, 3e-3]) / metres)
    path = tmp_path / f"part.{suffix}"
    path.write_bytes(exported(mesh, suffix, digits=12))
    intake = read_part(path, unit=unit)
    np.testing.assert_allclose(intake.size_mm, (8, 6, 3), rtol=1e-6)
    assert (intake.unit, intake.unit_source, intake.notes) == (unit, "as asked", ())


def exported(mesh, kind, **options):
    options = options if kind in ("obj", "off") else {}
    data = mesh.export(file_type=kind, **options)
    return data.encode() if isinstance(data, str) else data


def test_an_implausible_size_stops_with_the_question_and_its_answers(tmp_path):
    path = written(tmp_path / "part.ply", box((0.4, 0.3, 0.2)))
    with pytest.raises(MeshError, match=r"part\.ply is 0\.4 mm long.*10\.2 mm if they are in.*--unit.*--accept-size"):
        read_part(path)
    assert read_part(path, unit="in").size_mm[0] == pytest.approx(10.16, rel=1e-6)
    assert read_part(path, accept_size=True).size_mm[0] == pytest.approx(0.4, rel=1e-6)
    path = written(tmp_path / "part.ply", box((8000, 6000, 3000)))
    with pytest.raises(MeshError, match=r"8,000 mm long.*Answer with --unit um"):
        read_part(path)
    with pytest.raises(MeshError, match=r"'mile'.*mm"):
        read_part(path, unit="mile")
    wide = IntakeConfig(size_mm=(1, 10_000))
    assert read_part(path, config=wide).unit == "mm"


def test_settings_that_make_no_sense_are_refused():
    for wrong in ({"size_mm": (5, 1)}, {"time_limit_s": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            IntakeConfig(**wrong)
    for wrong in ({"gap_m": 0}, {"simplify_m": -1}, {"triangles": 3}, {"wrap_cells": 4}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            RepairConfig(**wrong)


# Files that are no part: one line, with the file's name and a remedy


def refusal(path, **options):
    with pytest.raises(CadError) as caught:
        read_part(path, **options)
    message = str(caught.value)
    assert path.name in message and "\n" not in message
    return message


def test_a_file_that_cannot_be_opened_is_named(tmp_path, monkeypatch):
    assert "no file" in refusal(tmp_path / "missing.step")
    assert "no file" in refusal(tmp_path / "nowhere" / "missing.stl")
    (tmp_path / "part.step").mkdir()
    assert "folder" in refusal(tmp_path / "part.step")
    (tmp_path / "part.xyz").write_text("1 2 3")
    assert ".stl" in refusal(tmp_path / "part.xyz")

    def forbidden(self):
        raise PermissionError(13, "Permission denied")

    (tmp_path / "part.stl").write_bytes(b"x")
    monkeypatch.setattr(Path, "read_bytes", forbidden)
    assert "permissions" in refusal(tmp_path / "part.stl")


@pytest.mark.parametrize("suffix", ["step", "stl", "ply", "obj", "off"])
def test_files_without_a_part_are_refused(tmp_path, suffix):
    path = tmp_path / f"größe_螺丝.{suffix}"
    for content in (b"", b" \n\n", b"hello, this is a text\n", bytes(500), bytes(range(256)) * 4):
        path.write_bytes(content)
        refusal(path)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "ply", "off"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.98])
def test_a_truncated_mesh_is_refused(tmp_path, kind, share):
    data = exported(trimesh.creation.annulus(1.5, 3, 2), kind)
    path = tmp_path / f"part.{kind.removesuffix('_ascii')}"
    path.write_bytes(data)
    read_part(path)
    path.write_bytes(data[: int(share * len(data))])
    refusal(path)


@pytest.mark.parametrize("share", [0.01, 0.3, 0.9, 0.998])
def test_a_truncated_step_file_is_refused(tmp_path, share):
    data = (PARTS / "m2_screw.step").read_bytes()
    path = tmp_path / "schräubchen.STEP"
    path.write_bytes(data[: int(share * len(data))])
    assert "cut short" in refusal(path)
    assert list(tmp_path.iterdir()) == [path]


def test_a_step_file_without_a_solid_is_refused(tmp_path):
    data = (PARTS / "bracket.step").read_bytes()
    path = tmp_path / "part.step"
    path.write_bytes(data.replace(b"MANIFOLD_SOLID_BREP", b"MANIFOLD_SOLID_SOUP"))
    assert "no solid" in refusal(path)
    path.write_bytes(b"ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\nENDSEC;\nEND-ISO-10303-21;\n")
    assert "cannot be read as STEP" in refusal(path)


def test_a_kernel_that_crashes_or_hangs_does_not_take_this_process_with_it(tmp_path, monkeypatch):
    worker = tmp_path / "worker.py"
    monkeypatch.setattr(cad.step, "_WORKER", worker)
    worker.write_text("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    with pytest.raises(MeshError, match=r"bracket\.step crashed the CAD kernel \(signal 11\)"):
        read_part(PARTS / "bracket.step")
    worker.write_text("import time; time.sleep(60)")
    with pytest.raises(MeshError, match=r"bracket\.step took the CAD kernel longer than 0\.2 s"):
        read_part(PARTS / "bracket.step", config=IntakeConfig(time_limit_s=0.2))


def test_numbers_that_are_none_are_refused(tmp_path):
    data = trimesh.creation.box((8, 6, 3)).export(file_type="stl")
    path = tmp_path / "part.stl"
    path.write_bytes(data[:84] + struct.pack("<12fH", *[float("nan")] * 12, 0) + data[134:])
    assert "not finite" in refusal(path)


def test_names_in_another_encoding_and_trailing_bytes_do_no_harm(tmp_path):
    mesh, latin = trimesh.creation.box((8, 6, 3)), "Größe".encode("latin-1")
    files = {
        "obj": b"# " + latin + b"\n" + exported(mesh, "obj"),
        "off": exported(mesh, "off").replace(b"OFF\n", b"OFF\n# " + latin + b"\n"),
        "ply": exported(mesh, "ply").replace(b" 1.0\n", b" 1.0\ncomment " + latin + b"\n", 1),
        "stl": exported(mesh, "stl_ascii").replace(b"solid", b"solid " + latin, 1),
        "STL": b"solid " + exported(mesh, "stl")[6:] + b"\r\n",  # binary, though it begins as text does
    }
    for suffix, data in files.items():
        path = tmp_path / f"part.{suffix}"
        path.write_bytes(data)
        same(read_part(path), *box())


# Surfaces as they should not be: the repaired part equals the clean one


def test_a_clean_mesh_is_left_as_it_is(tmp_path):
    vertices, faces = clean()
    intake = read_part(written(tmp_path / "part.ply", (vertices, faces)))
    same(intake, vertices, faces)
    assert intake.notes == () and intake.solids == 1
    assert len(intake.mesh.faces) == len(faces)


def faults():
    """Name, the bracket with a fault, and a word of the note that tells of it."""
    rng = np.random.default_rng(2)
    vertices, faces = clean()
    areas = trimesh.Trimesh(vertices, faces, process=False).area_faces
    large = np.argsort(-areas)
    some = np.sort(rng.choice(len(faces), 300, replace=False))
    turned = faces.copy()
    turned[some] = turned[some, ::-1]
    soup = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    point = np.stack([faces[:40, 0], faces[:40, 0], faces[:40, 1]], axis=1)
    return {
        "separate triangles": (*soup, ""),
        "inverted": (vertices, faces[:, ::-1], "inward normals"),
        "mixed winding": (vertices, turned, "wound against"),
        "everything twice": (vertices, np.concatenate([faces, faces]), "more than once"),
        "some twice, inverted": (vertices, np.concatenate([faces, faces[:50, ::-1]]), "more than once"),
        "degenerate triangles": (vertices, np.concatenate([faces, point]), "two corners at one place"),
        "unused vertices": (np.concatenate([vertices, [[90, 0, 0], [0, 70, 0]]]), faces, ""),
        "T-junctions": (*trimesh.remesh.subdivide(vertices, faces, face_index=large[:30]), "T-junction"),
        "holes": (vertices, np.delete(faces, large[:9], axis=0), "filled"),
        "one hole, all inverted": (vertices, np.delete(faces, large[:1], axis=0)[:, ::-1], "filled"),
    }


@pytest.mark.parametrize("fault", list(faults()))
def test_a_broken_mesh_comes_out_as_the_clean_one(tmp_path, fault):
    vertices, faces, word = faults()[fault]
    intake = read_part(written(tmp_path / "part.ply", (vertices, faces)))
    same(intake, *clean())
    assert any(word in note for note in intake.notes) or (not word and not intake.notes)


def test_small_gaps_are_closed_within_their_width(tmp_path):
    vertices, faces = clean()
    rng = np.random.default_rng(5)
    corners = vertices[faces].reshape(-1, 3)
    corners = corners + rng.uniform(-1e-3, 1e-3, corners.shape)  # a micrometre
    intake = read_part(written(tmp_path / "part.ply", (corners, np.arange(len(corners)).reshape(-1, 3))))
    same(intake, *clean(), ppm=500, um=2)
    assert any("gaps" in note for note in intake.notes)


def test_a_missing_face_with_an_island_is_filled_as_a_ring(tmp_path):
    ring = trimesh.creation.annulus(1.5, 3, 2)
    sides = np.abs(ring.face_normals[:, 2]) < 0.5
    intake = read_part(written(tmp_path / "part.ply", (np.array(ring.vertices), np.array(ring.faces)[sides])))
    same(intake, np.array(ring.vertices), np.array(ring.faces))
    assert any("4 holes filled" in note and "all flat" in note for note in intake.notes)


def two_boxes():
    """Two boxes that share a face, in every state of neglect; together they are a box of 16 x 6 x 3 mm."""
    one, other = box(), box(at=(8, 0, 0))
    turned = one[1].copy()
    turned[::3] = turned[::3, ::-1]
    wall = trimesh.creation.box((8, 6, 3)).face_normals[:, 0] < -0.5
    return {
        "sound": (one, other),
        "one inverted": (one, (other[0], other[1][:, ::-1])),
        "mixed winding": ((one[0], turned), (other[0], turned)),
        "one common wall": (one, (other[0], other[1][~wall])),
        "the same wall twice": (one, mirrored(other)),
        "the same wall twice, mixed winding": ((one[0], turned), mirrored(other)),
    }


@pytest.mark.parametrize("state", list(two_boxes()))
def test_boxes_that_share_a_face_become_one_box(tmp_path, state):
    intake = read_part(written(tmp_path / "part.ply", *two_boxes()[state]))
    same(intake, *box((16, 6, 3), at=(4, 0, 0)))


def test_overlapping_boxes_are_united(tmp_path):
    intake = read_part(written(tmp_path / "part.ply", box(), box(at=(1, 2, 1))))
    assert intake.mesh.volume * 1e9 == pytest.approx(2 * 144 - 7 * 4 * 2, rel=1e-6)
    assert any("2 solids united; they overlap by 56 mm3" in note for note in intake.notes)


@pytest.mark.parametrize("inward", [True, False])
@pytest.mark.parametrize("all_inverted", [True, False])
def test_what_lies_inside_is_left_out(tmp_path, inward, all_inverted):
    outer, (vertices, faces) = box(), box((4, 3, 1.5))
    pieces = [outer, (vertices, faces[:, ::-1] if inward else faces)]
    pieces = [(v, f[:, ::-1]) for v, f in pieces] if all_inverted else pieces
    intake = read_part(written(tmp_path / "part.ply", *pieces))
    same(intake, *outer)
    assert intake.solids == 2
    assert any("18 mm3" in note and "solid there" in note for note in intake.notes)


def test_a_cavity_between_solids_is_filled(tmp_path):
    walls = [box((8, 6, 1)), box((8, 6, 1), at=(0, 0, 3))]
    walls += [box((8, 1, 2), at=(0, y, 1.5)) for y in (-2.5, 2.5)] + [
        box((1, 4, 2), at=(x, 0, 1.5)) for x in (-3.5, 3.5)
    ]
    intake = read_part(written(tmp_path / "part.ply", *walls))
    same(intake, *box((8, 6, 4), at=(0, 0, 1.5)))
    assert any("48 mm3" in note and "filled" in note for note in intake.notes)


def test_separate_bodies_stay_and_are_told_of(tmp_path):
    intake = read_part(written(tmp_path / "part.ply", box(), box(at=(20, 0, 0))))
    assert intake.mesh.volume * 1e9 == pytest.approx(288, rel=1e-6)
    assert intake.mesh.body_count == 2
    assert any("2 bodies" in note for note in intake.notes)


def test_a_surface_without_thickness_is_refused(tmp_path):
    vertices, faces = box()
    top = trimesh.creation.box((8, 6, 3)).face_normals[:, 2] > 0.5
    path = written(tmp_path / "part.ply", (vertices, faces[top]))
    assert "no volume" in refusal(path)


def test_a_part_far_from_the_origin_gets_one_of_its_own(tmp_path):
    intake = read_part(written(tmp_path / "part.ply", box(at=(500, 0, 0))))
    same(intake, *box(), um=0.1, ppm=100)  # single precision at half a metre
    np.testing.assert_allclose(intake.origin_m, (0.5, 0, 0), atol=1e-7)
    assert any("500 mm" in note for note in intake.notes)


def test_a_surface_that_cannot_be_closed_is_wrapped_and_the_error_told(tmp_path):
    rng = np.random.default_rng(3)
    ring = trimesh.creation.annulus(1.5, 3, 2).subdivide().subdivide()
    faces = np.array(ring.faces)[rng.random(len(ring.faces)) > 0.1]  # a tenth is missing,
    turn = rng.random(len(faces)) < 0.5
    faces[turn] = faces[turn, ::-1]  # half is inverted
    third = len(faces) // 3
    torn = np.array(ring.vertices)[faces[:third]].reshape(-1, 3)
    torn += rng.uniform(-0.02, 0.02, torn.shape)  # and a third does not meet its neighbours
    pieces = (torn, np.arange(3 * third).reshape(-1, 3)), (np.array(ring.vertices), faces[third:])
    cells = RepairConfig(wrap_cells=64)
    intake = read_part(written(tmp_path / "part.ply", *pieces), config=IntakeConfig(repair=cells))
    check_mesh(intake.mesh)
    assert any("wrapped" in note and "um of the wrap" in note for note in intake.notes)
    assert intake.mesh.volume * 1e9 == pytest.approx(ring.volume, rel=0.03)
    np.testing.assert_allclose(intake.mesh.bounds, 1e-3 * ring.bounds, atol=50e-6)
    sound = trimesh.Trimesh(1e-3 * ring.vertices, ring.faces, process=False)
    assert np.percentile(Surface(sound).distance(np.asarray(intake.mesh.vertices[::20])), 95) < 50e-6


def test_a_part_of_many_triangles_is_simplified_within_its_tolerance(tmp_path):
    ball = trimesh.creation.icosphere(6, 4.0)
    ball.vertices *= [1.0, 0.7, 0.5]
    intake = read_part(written(tmp_path / "part.ply", (np.array(ball.vertices), np.array(ball.faces))))
    assert len(ball.faces) > 60_000 > 40_000 > len(intake.mesh.faces)
    assert any("simplified" in note and "2 um" in note for note in intake.notes)
    scaled = 1e-3 * np.asarray(ball.vertices)
    assert Surface(intake.mesh).largest(scaled) <= 2e-6


def test_nothing_is_left_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    before = set(os.listdir(PARTS))
    read_part(PARTS / "bracket.step")
    assert not list(tmp_path.iterdir()) and set(os.listdir(PARTS)) == before
