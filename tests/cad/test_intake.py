import os
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from part_files import PARTS, box, refusal, same, taken, written

import cad.step
from cad.intake import IntakeConfig, read_part
from cad.meshes import MeshError, check_mesh
from cad.step import declared_unit
from cad.surface import RepairConfig

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


def test_nothing_is_left_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    before = set(os.listdir(PARTS))
    read_part(PARTS / "bracket.step")
    assert not list(tmp_path.iterdir()) and set(os.listdir(PARTS)) == before
