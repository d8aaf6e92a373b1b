"""``tagcell estimate``: what is printed, what is written, and how it ends."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from cad.spatial import BASLER, rotation_x, transform
from perception.calibration_file import CellCalibration
from perception.estimates import FrameEstimate, PartEstimate, PoseAlternative
from perception.estimator import LearnedEstimator
from twin.cli import main

SMALL = BASLER.resampled(684, 456)


@pytest.fixture
def photo(tmp_path, monkeypatch):
    """A small photograph, and an estimator that sees two parts on every one."""
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), np.full((456, 684, 3), 90, np.uint8))
    turn = rotation_x(np.pi)
    other = PoseAlternative(part="top", stable_pose=1, T_cam_part=transform(turn, [-0.02, 0.01, 0.7]), probability=0.4)
    parts = (
        PartEstimate(part="main", T_cam_part=transform(turn, [0.01, 0.0, 0.7]), stable_pose=0, score=0.98),
        PartEstimate(
            part="top",
            T_cam_part=other.T_cam_part,
            stable_pose=0,
            score=0.3,
            verdict="ambiguous",
            alternatives=(replace(other, stable_pose=0, probability=0.6), other),
        ),
    )
    seen = FrameEstimate(T_cam_board=transform(turn, [0, 0, 0.7]), parts=parts, tags_seen=24, tag_rms_px=0.05)
    monkeypatch.setattr(LearnedEstimator, "estimate", lambda self, frame: seen)
    return path


def run(capsys, *arguments) -> tuple[int, str, str]:
    code = 0
    try:
        main(["estimate", *map(str, arguments)])
    except SystemExit as stopped:
        code = int(stopped.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_results_are_written_and_printed(capsys, photo, tmp_path):
    CellCalibration(intrinsics=SMALL, camera_serial="7").save(tmp_path / "calibration.json")
    out = tmp_path / "out"
    code, text, _ = run(capsys, photo, "--calibration", tmp_path / "calibration.json", "--out", out)
    assert code == 0
    assert "24 tags" in text and "ambiguous" in text and "0.98" in text and "photo.estimate.json" in text
    assert sorted(p.name for p in out.iterdir()) == ["photo.estimate.json", "photo.overlay.jpg"]
    stored = json.loads((out / "photo.estimate.json").read_text())
    assert [(p["part"], p["accepted"], p["verdict"]) for p in stored["parts"]] == [
        ("main", True, "accepted"),
        ("top", False, "ambiguous"),
    ]
    assert [(a["stable_pose"], a["probability"]) for a in stored["parts"][1]["alternatives"]] == [(0, 0.6), (1, 0.4)]
    assert stored["calibration"]["camera_serial"] == "7"
    assert stored["parts"][0]["x_board_mm"] == pytest.approx(10.0)
    assert set(stored["weights"]) >= {"segmentation.safetensors", "keypoints.safetensors"}


def test_json_is_one_list_and_failures_show_in_the_exit_code(capsys, photo, tmp_path):
    code, text, errors = run(
        capsys, photo, tmp_path / "none.png", photo, "--calibration", "nominal", "--out", tmp_path / "out", "--json"
    )
    first, missing, again = json.loads(text)
    assert len(first["parts"]) == len(again["parts"]) == 2 and "error" in missing
    assert code == 1
    assert "none.png" in errors and "1 of 3 photographs" in errors
    assert first["result"] != again["result"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--calibration", "nominal"), "no photograph is given"),
        (("PHOTO", "--calibration", "none.json"), "none.json cannot be read"),
        (("PHOTO", "--calibration", "nominal", "--parts", "gizmo"), "gizmo"),
        (("PHOTO", "--calibration", "nominal", "--weights", "nowhere"), "tagcell train"),
        (("PHOTO", "--calibration", "nominal", "--out", "PHOTO/out"), "--out"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_written(capsys, photo, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    code, _, errors = run(capsys, *(argument.replace("PHOTO", str(photo)) for argument in arguments))
    assert code == 1 and errors.startswith("tagcell: ") and said in errors
    assert not list((tmp_path).rglob("*.estimate.json"))


def test_a_calibration_is_required(capsys, photo):
    code, _, errors = run(capsys, photo)
    assert code == 2 and "calibration" in errors
