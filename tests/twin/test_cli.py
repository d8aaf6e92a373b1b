"""Wrong input ends in one clear line and a non-zero exit, before any work is done."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from cad.parts import part_names
from twin.__main__ import main as start
from twin.cli import main


def fails(capsys, *arguments: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as stopped:
        main(list(arguments))
    captured = capsys.readouterr()
    return stopped.value.code, " ".join((captured.out + captured.err).replace("│", " ").split())


def test_an_unknown_part_names_the_parts_there_are(capsys):
    code, text = fails(capsys, "pick", "--parts", "gizmo")
    assert code == 2 and "gizmo" in text and "inserted, main, top" in text
    code, text = fails(capsys, "part", "show", "gizmo")
    assert code == 1 and text == "tagcell: no part is called 'gizmo'; parts there are: inserted, main, top"


@pytest.mark.parametrize(("flag", "value"), [("--scenes", "-3"), ("--parts-per-class", "0"), ("--jobs", "0")])
def test_counts_outside_their_range_are_refused(capsys, flag, value):
    code, text = fails(capsys, "pick", flag, value)
    assert code == 2 and f"{flag[2:]} is {value}; it must be between 1 and" in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--exposure -1", "exposure is -1.0; it must be positive"),
        ("--second-looks nudge nudge", "second-looks are nudge, nudge; name each kind once"),
        ("--second-looks stare", "stare"),
    ],
)
def test_looks_that_make_no_sense_are_refused(capsys, arguments, said):
    code, text = fails(capsys, "pick", *arguments.split())
    assert code == 2 and said in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("part stable-poses main --drops 0", "drops 0"),
        ("part stable-poses main --seed -1", "seed -1"),
        ("render --seed -1", "seed -1"),
        ("train --minutes -1", "minutes is -1"),
        ("train --seed -1", "seed is -1"),
        ("view --seed -1", "seed is -1"),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(capsys, monkeypatch, tmp_path, arguments, said):
    monkeypatch.chdir(tmp_path)
    code, text = fails(capsys, *arguments.split())
    assert code == 1 and text.startswith(f"tagcell: {said}")


def test_a_value_of_the_wrong_kind_names_flag_and_value(capsys):
    code, text = fails(capsys, "pick", "--scenes", "many")
    assert code == 2 and "--scenes" in text and "'many'" in text


def test_an_unwritable_folder_is_found_before_any_scene_runs(capsys, tmp_path):
    (tmp_path / "file").write_text("kept")
    code, text = fails(capsys, "pick", "--estimator", "oracle", "--out", str(tmp_path / "file" / "out"))
    assert code == 1 and "cannot write to" in text and "--out" in text
    assert (tmp_path / "file").read_text() == "kept"


def test_missing_weights_name_the_folder_and_the_remedy(capsys, tmp_path):
    code, text = fails(capsys, "pick", "--weights", str(tmp_path / "none"), "--out", str(tmp_path / "out"))
    assert code == 1 and str(tmp_path / "none") in text and "tagcell train" in text


def test_a_machine_that_cannot_render_is_told_what_to_do(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "twin", "pick", "--estimator", "oracle", "--scenes", "1", "--out", str(tmp_path)],
        env=os.environ | {"MUJOCO_GL": "disable"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "cannot render" in done.stderr and "apt-get install" in done.stderr
    assert "Traceback" not in done.stderr


def test_parts_are_listed_for_people_and_machines(capsys):
    main(["part", "list", "--json"])
    parts = json.loads(capsys.readouterr().out)
    assert [p["name"] for p in parts] == part_names()
    main(["part", "show", "main"])
    text = capsys.readouterr().out
    assert "main" in text and "stable poses" in text


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (["--out", "FILE/out"], "choose another folder with --out"),
        (["--seed", "-1"], "seed -1"),
        (["--drops", "0"], "drops 0"),
    ],
)
def test_stable_poses_refuse_before_any_drop(capsys, tmp_path, monkeypatch, changes, said):
    monkeypatch.setattr("twin.stable_pose_report.stable_pose_report", lambda *_: pytest.fail("parts were dropped"))
    (tmp_path / "file").touch()
    words = [word.replace("FILE", str(tmp_path / "file")) for word in changes]
    code, text = fails(capsys, "part", "stable-poses", "main", "--out", str(tmp_path / "out"), *words)
    assert code == 1 and text.startswith("tagcell: ") and said in text


def test_ctrl_c_before_a_verb_runs_ends_in_one_line(capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("twin.cli.tyro.cli", stop)
    with pytest.raises(SystemExit) as stopped:
        start()
    assert stopped.value.code == 130
    assert capsys.readouterr().err.strip() == "tagcell: stopped"


def test_ctrl_c_while_packages_are_imported_ends_in_one_line():
    code = """
import signal, sys
class Interrupting:
    def find_spec(self, name, *_):
        if name == "twin.cli":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
from twin.__main__ import main
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.strip()) == (130, "tagcell: stopped")


def test_help_shows_every_verb(capsys):
    code, text = fails(capsys, "--help")
    assert code == 0
    for verb in ("pick", "render", "train", "part", "view", "doctor"):
        assert verb in text
