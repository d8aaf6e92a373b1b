"""Estimators over the frames of a data set: what is kept, and that a stopped run goes on where it was."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_frames import LAYOUT, Told, right_answer, seen, write_frames

from perception.estimates import FrameEstimate, PerceptionError
from perception.evaluate import TOTAL, FrameRecord, evaluate, outcomes_of, read_records, record_path
from perception.ground_truth import FrameTruth, GroundTruth, read_ground_truth


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> GroundTruth:
    folder = tmp_path_factory.mktemp("frames") / "data"
    return read_ground_truth(write_frames(folder, [LAYOUT[:2], LAYOUT[1:], LAYOUT]))


def as_plain(records: list[FrameRecord]) -> list:
    return [(r.image, r.outcomes, r.detections, [(p.obj_id, p.T_cam_part.tolist()) for p in r.poses]) for r in records]


def test_records_are_those_read_again(truth, tmp_path) -> None:
    heard: list[tuple[int, int, str]] = []
    made = evaluate(
        truth, {"told": Told(truth.frames, right_answer)}, tmp_path, progress=lambda *now: heard.append(now)
    )["told"]
    assert as_plain(read_records(tmp_path, "told")) == as_plain(made)
    assert [len(r.outcomes) for r in made] == [2, 2, 3] and all(o.branch_right for o in outcomes_of(made))
    assert [r.seconds["thinking"] for r in made] == [0.5] * 3 and all(r.seconds[TOTAL] >= 0 for r in made)
    assert heard[0] == (0, 3, "told") and heard[-1][:2] == (3, 3)
    (pose,) = [p for p in made[1].bop_poses() if p.obj_id == 2][:1]
    assert (pose.scene_id, pose.im_id, pose.time_s) == (0, 1, made[1].seconds[TOTAL])
    np.testing.assert_allclose(pose.T_cam_part, truth.frames[1].parts[0].T_cam_part)
    assert {d["category_id"] for d in made[0].detections} == {1, 2} and made[0].detections[0]["image_id"] == 0


def test_a_stopped_run_goes_on_where_it_was(truth, tmp_path) -> None:
    def stop_at_the_second(frame: FrameTruth) -> FrameEstimate:
        if frame.image == 1:
            raise KeyboardInterrupt
        return right_answer(frame)

    with pytest.raises(KeyboardInterrupt):
        evaluate(truth, {"told": Told(truth.frames, stop_at_the_second)}, tmp_path)
    assert [p.name for p in sorted((tmp_path / "estimates" / "told").iterdir())] == ["000000.json"]
    again = Told(truth.frames, right_answer)
    records = evaluate(truth, {"told": again}, tmp_path)["told"]
    assert again.calls == [1, 2] and [r.image for r in records] == [0, 1, 2]


def test_another_version_or_other_data_is_evaluated_anew(truth, tmp_path) -> None:
    for version, manifest, calls in (("a", "x", 3), ("a", "x", 0), ("b", "x", 3), ("b", "y", 3)):
        told = Told(truth.frames, right_answer)
        evaluate(replace(truth, manifest=manifest), {"told": told}, tmp_path, versions={"told": version})
        assert len(told.calls) == calls


def test_frames_that_cannot_be_used_are_missed_and_say_why(truth, tmp_path) -> None:
    def no_tags(frame: FrameTruth) -> FrameEstimate:
        raise PerceptionError("2 tags seen")

    records = evaluate(truth, {"blind": Told(truth.frames, no_tags)}, tmp_path)["blind"]
    assert {r.note for r in records} == {"2 tags seen"} and not any(o.detected for o in outcomes_of(records))
    assert len(outcomes_of(records)) == truth.n_parts and read_records(tmp_path, "blind")[0].note == "2 tags seen"


def test_poses_before_refinement_can_be_a_method_of_their_own(truth, tmp_path) -> None:
    told = Told(truth.frames, right_answer)
    records = evaluate(truth, {"fine": told}, tmp_path, raw_names={"fine": "rough"})
    assert told.calls == [0, 1, 2] and list(records) == ["fine", "rough"]
    (fine, *_), (rough, *_) = outcomes_of(records["fine"]), outcomes_of(records["rough"])
    assert fine.raw_errors == rough.errors and rough.raw_errors is None and rough.method == "rough"
    record_path(tmp_path, "rough", 1).unlink()
    told.calls.clear()
    evaluate(truth, {"fine": told}, tmp_path, raw_names={"fine": "rough"})
    assert told.calls == [1]


def test_each_method_gets_a_frame_of_its_own(truth, tmp_path) -> None:
    class Keeper(Told):
        def estimate(self, frame):
            assert "half" not in vars(frame)
            assert frame.half.shape[0] == frame.image.shape[0] // 2
            return super().estimate(frame)

    methods = {name: Keeper(truth.frames, right_answer) for name in ("a", "b")}
    assert len(evaluate(truth, methods, tmp_path)["b"]) == 3


def test_only_whole_frames_are_evaluated(truth, tmp_path) -> None:
    with pytest.raises(PerceptionError, match="kind 'window'"):
        evaluate(replace(truth, dataset={**truth.dataset, "kind": "window"}), {}, tmp_path)


def test_a_method_that_was_not_evaluated_is_named(truth, tmp_path) -> None:
    evaluate(truth, {"told": Told(truth.frames, lambda f: seen())}, tmp_path)
    with pytest.raises(PerceptionError, match="methods there are: told"):
        read_records(tmp_path, "other")


def test_data_of_another_mesh_are_refused(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "data", [LAYOUT])
    text = (folder / "dataset.json").read_text()
    (folder / "dataset.json").write_text(text.replace('"mesh": "', '"mesh": "0', 1))
    with pytest.raises(PerceptionError, match="render the data set again"):
        read_ground_truth(folder)
