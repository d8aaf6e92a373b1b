"""`tagcell evaluate`: what it renders, refuses, takes up again and writes."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from made_frames import LAYOUT, Told, estimate_of, moved, right_answer, seen, write_frames
from painted import PaintedMaker

from perception.bop_results import read_bop_results
from perception.estimates import FrameEstimate
from perception.evaluation_curves import plot_mssd_recall
from perception.ground_truth import centre_of, read_ground_truth
from perception.stored_detections import StoredDetections
from scenes.recipes import load_recipe
from twin.cli import main
from twin.evaluation_config import EvaluationConfig


def fails(capsys, *arguments):
    with pytest.raises(SystemExit) as stopped:
        main(["evaluate", *map(str, arguments)])
    captured = capsys.readouterr()
    return stopped.value.code, " ".join((captured.out + captured.err).replace("│", " ").split())


@pytest.fixture
def data(tmp_path):
    """Two frames of three parts, of split val."""
    return write_frames(tmp_path / "data", [LAYOUT, LAYOUT])


@pytest.fixture
def weights(tmp_path):
    """A folder that weights might be in; the estimators of these tests need none."""
    folder = tmp_path / "weights"
    folder.mkdir()
    for name in ("classifier.safetensors", "segmentation.safetensors", "pvnet.safetensors", "choice.json"):
        (folder / name).write_text(json.dumps({"fitted_on": "val_fine (1234)", "of": name}))
    return folder


@pytest.fixture
def told(data, monkeypatch):
    """Makes the command use estimators that answer as told."""

    def use(**answers):
        frames = read_ground_truth(data).frames
        estimators = {name: Told(frames, answer) for name, answer in answers.items()}
        monkeypatch.setattr("twin.evaluation.load_estimators", lambda config: estimators)
        return estimators

    return use


@pytest.fixture
def no_plots(monkeypatch):
    """Plots take seconds; they are tested elsewhere."""
    monkeypatch.setattr("twin.evaluation.write_plots", lambda outcomes, out: [])


def poor_answer(truth):
    """One part right, one turned by half a turn, one missed, and a detection where nothing lies."""
    right, turned, missed = truth.parts
    T = moved(turned, yaw=np.pi)
    T[:3, 3] += centre_of(turned.part, turned.T_cam_part) - centre_of(turned.part, T)
    flip = estimate_of(turned, T, score=0.8)
    nothing = estimate_of(missed, moved(missed, x_m=0.015, y_m=0.01), score=0.7)
    return seen(estimate_of(right), flip, nothing)


def test_everything_is_written_and_told_to_people_and_machines(told, data, weights, tmp_path, capsys, monkeypatch):
    told(tagcell=right_answer, **{"pvnet-refined": poor_answer})
    monkeypatch.setattr(
        "perception.evaluation_plots.PLOTS", {"mssd_recall": plot_mssd_recall}
    )  # the others have a test
    out = tmp_path / "out"
    command = ["evaluate", "--data", str(data), "--split", "val", "--weights", str(weights), "--out", str(out)]
    main(command)
    text = capsys.readouterr().out
    assert text.startswith("# Evaluation: classic") and "2 whole frames" in text and str(out / "evaluation.md") in text
    assert "## Table 2" in (out / "evaluation.md").read_text()
    monkeypatch.setattr("twin.evaluation.write_plots", lambda outcomes, out: [])
    main([*command, "--json"])
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads((out / "evaluation.json").read_text())
    assert (report["n_images"], report["n_parts"], report["splits"]["evaluated"]) == (2, 6, "val")
    assert report["pose"]["tagcell"]["all"]["branch_right"] == 1.0
    assert report["pose"]["pvnet-refined"]["all"]["flip_rate"] == 0.5
    assert report["config"]["split"] == "val" and "out" not in report["config"]
    assert set(report["weights"]["tagcell"]) == {"choice.json", "classifier.safetensors", "segmentation.safetensors"}
    assert set(report["weights"]["pvnet-refined"]) == {"pvnet.safetensors", "segmentation.safetensors"}
    assert "mujoco" in report["versions"]

    methods = {"tagcell", "pvnet-refined", "pvnet"}
    pictures = {"mssd_recall", *(f"confusion_{m}" for m in methods)}
    pictures |= {"failures", "failures_pvnet", "failures_pvnet-refined"}
    assert {p.stem for p in out.glob("*.png")} == pictures
    assert {p.name for p in (out / "bop").iterdir()} == {f"{m}_tagcell-val.csv" for m in methods}
    poses = read_bop_results(out / "bop" / "tagcell_tagcell-val.csv")
    truth = read_ground_truth(data)
    assert len(poses) == 6
    np.testing.assert_allclose(poses[0].T_cam_part, truth.frames[0].parts[0].T_cam_part, atol=1e-9)
    found = json.loads((out / "coco" / "pvnet-refined.json").read_text())
    assert sorted(d["image_id"] for d in found) == [0, 0, 0, 1, 1, 1]


def test_failures_are_shown_as_pictures_with_both_outlines(no_plots, told, data, weights, tmp_path):
    told(tagcell=poor_answer)
    out = tmp_path / "out"
    main(["evaluate", "--data", str(data), "--split", "val", "--weights", str(weights), "--out", str(out)])
    sheet = cv2.imread(str(out / "failures.png")).astype(int)
    green = (sheet[..., 1] > 180) & (sheet[..., 0] < 100) & (sheet[..., 2] < 100)
    red = (sheet[..., 2] > 200) & (sheet[..., 0] < 100) & (sheet[..., 1] < 100)
    assert green.sum() > 200 and red.sum() > 200
    told(tagcell=right_answer)
    main(
        ["evaluate", "--data", str(data), "--split", "val", "--weights", str(weights), "--out", str(tmp_path / "good")]
    )
    assert cv2.imread(str(tmp_path / "good" / "failures.png")).shape[0] < 50 < sheet.shape[0]


def test_a_stopped_evaluation_goes_on_where_it_was(no_plots, told, data, weights, tmp_path, capsys):
    def stop_at_the_second(truth):
        if truth.image == 1:
            raise KeyboardInterrupt
        return right_answer(truth)

    out = tmp_path / "out"
    command = ["--data", data, "--split", "val", "--weights", weights, "--out", out]
    told(tagcell=stop_at_the_second)
    code, text = fails(capsys, *command)
    assert code == 130 and "kept" in text
    assert not (out / "evaluation.json").exists()
    estimators = told(tagcell=right_answer)
    main(["evaluate", *map(str, command)])
    assert estimators["tagcell"].calls == [1]
    assert f"1 of 2 frames were estimated before from the same data and weights and are kept; delete {out}" in (
        capsys.readouterr().err
    )
    (weights / "classifier.safetensors").write_text("trained again")
    main(["evaluate", *map(str, command)])
    assert estimators["tagcell"].calls == [1, 0, 1]


def test_frames_are_rendered_of_split_test_then_evaluated(no_plots, monkeypatch, weights, tmp_path, capsys):
    class Nothing:
        def estimate(self, frame):
            return FrameEstimate(T_cam_board=np.eye(4), parts=(), tags_seen=9, tag_rms_px=0.1)

    full = EvaluationConfig.dataset
    monkeypatch.setattr("scenes.workers.ImageMaker", PaintedMaker)
    monkeypatch.setattr("twin.evaluation.load_estimators", lambda config: {"tagcell": Nothing()})
    monkeypatch.setattr(EvaluationConfig, "dataset", lambda self: replace(full(self), size=(128, 96)))
    command = ["evaluate", "--domain", "classic", "--count", "3", "--jobs", "1", "--weights", str(weights)]
    main([*command, "--out", str(tmp_path), "--json"])
    report = json.loads(capsys.readouterr().out)
    dataset = json.loads((tmp_path / "frames" / "dataset.json").read_text())
    assert (dataset["split"], dataset["kind"], dataset["faces"]) == ("test", "scene", "physics")
    assert report["n_images"] == 3 and report["splits"]["evaluated"] == "test"
    assert report["pose"]["tagcell"]["all"]["missed_share"] == 1.0


@pytest.mark.parametrize("domain", ["classic", "filament", "mitsuba"])
@pytest.mark.parametrize("faces", ["physics", "uniform"])
def test_frames_are_those_of_the_recipes_at_full_size_of_split_test(tmp_path, domain, faces):
    given = EvaluationConfig(out=tmp_path, domain=domain, faces=faces).dataset()
    recipe = load_recipe(f"eval_frames_{domain}{'_uniform' if faces == 'uniform' else ''}")
    assert given == recipe
    assert (given.kind, given.split, given.domain, given.faces) == ("scene", "test", domain, faces)
    assert given.pixels == (5472, 3648)
    other = EvaluationConfig(out=tmp_path, domain=domain, faces=faces, seed=2, count=4).dataset()
    assert (other.count, other.seed) == (4, recipe.seed + 2000)
    many = EvaluationConfig(out=tmp_path, domain=domain, faces=faces, instances=200, part=("top",)).dataset()
    assert (many.count, many.instances, many.names) == (None, 200, ("top",))


def test_the_first_frames_of_a_data_set_are_enough_if_asked_for(no_plots, told, data, weights, tmp_path, capsys):
    estimators = told(tagcell=right_answer)
    command = ["--data", data, "--split", "val", "--weights", weights, "--out", tmp_path / "out"]
    main(["evaluate", *map(str, command), "--count", "1"])
    assert estimators["tagcell"].calls == [0]
    code, text = fails(capsys, *command, "--count", "5")
    assert code == 1 and f"count 5: {data} has 2 frames" in text


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ("--domain blender", 2, "--domain"),
        ("", 1, "give --domain, one of classic, filament, mitsuba, or a data set with --data"),
        ("--domain classic --count 0", 1, "count 0: must be at least 1"),
        ("--domain classic --instances 0", 1, "instances 0: must be at least 1"),
        ("--domain classic --seed -1", 1, "seed -1: must be at least 0"),
        ("--domain classic --jobs 0", 1, "jobs 0: must be at least 1"),
        ("--domain classic --count 5 --instances 5", 1, "--count 5 and --instances 5: give one of them"),
        ("--domain classic --split val", 1, "--split val goes with --data only"),
        ("--domain classic --methods guess", 2, "--methods"),
        ("--domain classic --part gizmo", 1, "no part is called 'gizmo'"),
        ("--data NONE", 1, "no dataset.json in"),
        ("--data DATA --faces uniform", 1, "--faces uniform and --data"),
        ("--data DATA --seed 3", 1, "--seed 3 and --data"),
        ("--data DATA", 1, "is of split 'val', not 'test': choices were made on it; if that is what you want"),
        ("--data DATA --split val --domain filament", 1, "which is of domain 'classic'"),
    ],
)
def test_wrong_arguments_end_in_one_clear_line(capsys, data, tmp_path, arguments, code, said):
    words = arguments.replace("DATA", str(data)).replace("NONE", str(tmp_path / "none")).split()
    found, text = fails(capsys, *words, "--out", tmp_path / "out")
    assert found == code and said in text
    assert code == 2 or text.startswith("tagcell: ")
    assert not list((tmp_path / "out").glob("*")) or not (tmp_path / "out").exists()


def test_images_that_networks_may_have_learned_are_refused(told, capsys, data, weights, tmp_path):
    told(tagcell=right_answer)
    manifest = read_ground_truth(data).manifest
    (weights / "classifier.json").write_text(json.dumps({"data": {"train": f"1234 {manifest}"}}))
    code, text = fails(capsys, "--data", data, "--split", "val", "--weights", weights, "--out", tmp_path / "out")
    assert code == 1 and "the weights classifier were made from" in text
    about = json.loads((data / "dataset.json").read_text())
    (data / "dataset.json").write_text(json.dumps(about | {"split": "train"}))
    code, text = fails(capsys, "--data", data, "--split", "val", "--weights", weights, "--out", tmp_path / "out")
    assert code == 1 and "is of split 'train': networks may have learned these very images" in text
    assert "--split" in fails(capsys, "--data", data, "--split", "train")[1]


def test_detections_of_others_come_into_the_table_if_they_are_of_these_frames(
    no_plots, told, data, weights, tmp_path, capsys
):
    told(tagcell=right_answer)
    truth = read_ground_truth(data)
    part = truth.frames[0].parts[0]
    result = {
        "image_id": 0,
        "category_id": part.part.obj_id,
        "segmentation": part.runs,
        "bbox": [0, 0, 1, 1],
        "score": 0.9,
    }
    found = StoredDetections(
        method="mask-rcnn",
        weights="12",
        data=truth.manifest,
        min_score=0.5,
        seconds={0: 1.0, 1: 1.0},
        results=(result,),
    )
    found.write(tmp_path / "found.json")
    command = ["--data", data, "--split", "val", "--weights", weights, "--detections", tmp_path / "found.json"]
    main(["evaluate", *map(str, command), "--out", str(tmp_path / "out"), "--json"])
    report = json.loads(capsys.readouterr().out)
    assert report["segmentation_by_method"]["mask-rcnn"]["recall50"] == pytest.approx(1 / 6)
    assert report["segmentation"]["recall50"] == 1.0
    replace(found, data="another").write(tmp_path / "found.json")
    code, text = fails(capsys, *command, "--out", tmp_path / "other")
    assert code == 1 and "holds detections of the data set another" in text
    assert not (tmp_path / "other" / "estimates").exists()


def test_missing_weights_are_found_before_anything_is_rendered(capsys, tmp_path):
    for methods in (["tagcell"], ["pvnet"]):
        arguments = ["--domain", "classic", "--methods", *methods, "--weights", tmp_path / "none", "--out", tmp_path]
        code, text = fails(capsys, *arguments)
        assert code == 1 and str(tmp_path / "none") in text and "train" in text
    assert "--methods tagcell" in text
    assert not (tmp_path / "frames").exists()


def test_help_fits_80_columns(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main(["evaluate", "--help"])
    text = capsys.readouterr().out
    assert text.startswith("usage: tagcell evaluate") and max(map(len, text.splitlines())) <= 80
