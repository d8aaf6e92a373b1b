"""Tables of an evaluation from outcomes whose figures are known."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from made_frames import LAYOUT, Told, estimate_of, moved, right_answer, seen, write_frames
from made_outcomes import made_outcomes

from perception.bootstrap import FrameBootstrap, clopper_pearson_upper
from perception.breakdowns import (
    by_brightness,
    by_face,
    by_position,
    confusion,
    consistency,
    covariance_figures,
)
from perception.evaluate import evaluate
from perception.evaluation_report import evaluation_markdown
from perception.evaluation_tables import evaluation_tables, goals, headline, json_ready, latency_figures
from perception.ground_truth import read_ground_truth
from perception.outcomes import Outcome, outcome_from_json, outcome_to_json
from perception.pose_tables import pose_table
from perception.references import ACCEPTED_SHARE, GOALS, PAPER_REFINED

PARTS = ("inserted", "main", "top")
BOOTSTRAP = FrameBootstrap(range(50), np.random.default_rng(0), 100)


@pytest.fixture(scope="module")
def rows() -> list[Outcome]:
    return made_outcomes("tagcell", 300, 1, wrong=0.1, missed=0.05)


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """Two frames; the baseline is ten times further off, finds one part less and has a raw row."""
    folder = tmp_path_factory.mktemp("evaluation")
    truth = read_ground_truth(write_frames(folder / "data", [LAYOUT, LAYOUT[:2]]))

    def off(frame, by_m: float, parts: slice):
        return seen(*(estimate_of(p, moved(p, by_m, -by_m, by_m * 10)) for p in frame.parts[parts]))

    methods = {
        "tagcell": Told(truth.frames, lambda f: off(f, 2e-5, slice(None))),
        "pvnet-refined": Told(truth.frames, lambda f: off(f, 2e-4, slice(2))),
    }
    records = evaluate(truth, methods, folder / "out", raw_names={"pvnet-refined": "pvnet"})
    return truth, records


def test_outcomes_survive_json(rows) -> None:
    assert [outcome_from_json(json.loads(json.dumps(outcome_to_json(o)))) for o in rows] == rows
    with pytest.raises(Exception, match="unknown fields"):
        outcome_from_json({**outcome_to_json(rows[0]), "colour": 1})


def test_shares_are_counts_over_what_they_are_of(rows) -> None:
    table = pose_table(rows, PARTS, BOOTSTRAP)
    there = [o for o in rows if o.is_part and o.whole]
    for name in PARTS:
        own = [o for o in there if o.part == name]
        found = [o for o in own if o.detected]
        figures = table[name]
        assert figures["n_parts"] == len(own) and figures["n_detected"] == len(found) < len(own)
        assert figures["missed_share"] == pytest.approx(1 - len(found) / len(own))
        assert figures["branch_right_equivalent"] == pytest.approx(np.mean([o.branch_right_equivalent for o in found]))
        assert figures["flip_rate"] == pytest.approx(np.mean([o.flipped for o in found]))
        assert figures["e_x_mm"]["n"] == len(found)
        assert figures["refined"]["right"]["symmetric"]["e_theta_deg"]["p95"] < 1.0
        assert figures["raw"]["all"]["strict"]["e_z_mm"]["mean"] == pytest.approx(30 * figures["e_z_mm"]["mean"])
    total = table["all"]
    assert total["n_parts"] == sum(table[name]["n_parts"] for name in PARTS)
    assert total["n_accepted"] == sum(table[name]["n_accepted"] for name in PARTS)
    low, high = total["intervals_95"]["branch_right_equivalent"]
    assert low < total["branch_right_equivalent"] < high


def test_accepted_detections_of_nothing_are_bad() -> None:
    good = [replace(o, image=k) for k, o in enumerate(made_outcomes("m", 30, 0, wrong=0.0, missed=0.0)) if o.is_part]
    good = [replace(o, accepted=True, whole=True) for o in good]
    stray = Outcome(method="m", domain="classic", image=0, instance=-1, accepted=True, estimated_part="top")
    table = pose_table([*good, stray, replace(stray, whole=False), replace(stray, accepted=False)], PARTS, BOOTSTRAP)
    n = len(good) + 1
    assert (table["all"]["n_bad"], table["all"]["n_accepted"]) == (1, n)
    assert table["all"]["bad_share"] == pytest.approx(1 / n)
    assert table["all"]["bad_share_upper_95"] == pytest.approx(clopper_pearson_upper(1, n))
    assert table["top"]["n_bad"] == 1 and table["main"]["n_bad"] == 0 and table["all"]["accepted_share"] == 1.0


def test_missed_parts_fail_the_surface_recall(rows) -> None:
    there = [o for o in rows if o.is_part and o.whole]
    recall = pose_table(rows, PARTS, BOOTSTRAP)["all"]["mssd_recall"]
    assert list(recall) == ["0.05", "0.1", "0.2", "0.5", "1"] and list(recall.values()) == sorted(recall.values())
    assert recall["1"] == pytest.approx(np.mean([o.mssd_mm is not None and o.mssd_mm <= 1.0 for o in there]))


def test_parts_that_are_not_whole_do_not_count(rows) -> None:
    cut = [replace(o, whole=False) for o in rows]
    with_cut, without = (pose_table(given, PARTS, BOOTSTRAP) for given in ([*rows, *cut], rows))
    assert json_ready(with_cut) == json_ready(without)
    assert confusion([*rows, *cut]) == confusion(rows) and by_face([*rows, *cut]) == by_face(rows)


def test_confusion_counts_every_part_once(rows) -> None:
    counts = confusion(rows)
    whole = [o for o in rows if o.whole]
    assert sum(n for row in counts["class"].values() for n in row.values()) == len(whole)
    assert sum(counts["class"]["no part"].values()) == sum(not o.is_part for o in whole)
    assert sum(row["flipped"] for row in counts["flip"].values()) == sum(o.flipped for o in whole)


def test_bins_hold_all_parts_in_order(rows) -> None:
    there = sum(o.is_part and o.whole for o in rows)
    for bins in (by_position(rows), by_brightness(rows)):
        assert sum(b["n"] for b in bins) == there and len(bins) == 4
        assert all(a["to"] <= b["from"] for a, b in pairwise(bins))
    assert sum(g["n"] for g in by_face(rows)) == there


def test_covariances_that_hold_are_within_bounds_and_others_are_not() -> None:
    rng = np.random.default_rng(0)
    held = consistency(rng.chisquare(6, 400).tolist(), 6)
    assert held["within_bounds"] and held["within_95"] == pytest.approx(0.95, abs=0.04)
    assert not consistency((2.0 * rng.chisquare(6, 400)).tolist(), 6)["within_bounds"]
    assert not consistency((0.5 * rng.chisquare(3, 400)).tolist(), 3)["within_bounds"]
    figures = covariance_figures(made_outcomes("tagcell", 300, 5), PARTS)
    assert figures["all"]["nees"]["n"] == sum(figures[p]["nees"]["n"] for p in PARTS) > 100


def twenty_times(errors):
    return errors and {c: {e: 20.0 * v for e, v in of.items()} for c, of in errors.items()}


def test_the_headline_compares_the_parts_that_both_found() -> None:
    ours = made_outcomes("tagcell", 200, 3, wrong=0.0, missed=0.0)
    theirs = [replace(o, method="pvnet-refined", errors=twenty_times(o.errors)) for o in ours]
    lost = theirs[10]
    figures = headline({"tagcell": ours, "pvnet-refined": [o for o in theirs if o is not lost]}, BOOTSTRAP)
    whole = [o for o in ours if o.is_part and o.whole]
    assert figures["n"] == len(whole) and figures["n_common"] == len(whole) - lost.whole
    for error, ratio in figures["ratio"].items():
        assert ratio["mean"] == pytest.approx(20.0) and ratio["median"] == pytest.approx(20.0)
        assert ratio["mean_interval_95"] == pytest.approx((20.0, 20.0))
        expected = PAPER_REFINED["all"][error] / figures["mean"][error]
        assert figures["ratio_to_paper"][error] == pytest.approx(expected)


def test_evaluation_json_has_its_fields_and_is_json(evaluated) -> None:
    truth, records = evaluated
    tables = evaluation_tables(truth, records, splits={"train": "seeds 1, 2"}, draws=50)
    assert json.loads(json.dumps(tables, allow_nan=False)) == json.loads(json.dumps(tables))
    assert (tables["domain"], tables["n_images"], tables["n_parts"]) == ("classic", 2, 5)
    assert tables["splits"] == {"evaluated": "val", "manifest": truth.manifest, "train": "seeds 1, 2"}
    assert {"miou", "ap", "ap50", "ap75", "ar", "precision50", "recall50"} <= set(tables["segmentation"])
    assert (
        set(tables["pose"]) == {"tagcell", "pvnet-refined", "pvnet"} and "pvnet" not in tables["segmentation_by_method"]
    )
    figures = tables["pose"]["tagcell"]["main"]
    assert set(figures["e_x_mm"]) == {"mean", "std", "median", "p95", "n"}
    assert figures["e_x_mm"]["mean"] == pytest.approx(0.02) and figures["branch_right"] == 1.0
    assert {"accepted_share", "bad_share_upper_95", "flip_rate", "class_right"} <= set(figures)
    assert tables["pose"]["pvnet"]["main"]["e_z_mm"]["mean"] == pytest.approx(20.0)
    assert tables["headline"]["ratio"]["e_x_mm"]["mean"] == pytest.approx(10.0) and tables["headline"]["n_common"] == 4
    assert tables["latency_s"]["thinking"]["p50"] == 0.5 and tables["calibration_of_covariance"] == {}
    assert tables["pose"]["tagcell"]["top"]["e_x_mm"]["mean"] is None  # no such part was shown


def test_instances_without_poses_stand_beside_the_others(evaluated) -> None:
    truth, records = evaluated
    others = {"maskrcnn": [d for record in records["tagcell"] for d in record.detections][:4]}
    tables = evaluation_tables(truth, records, instances=others, min_scores={"maskrcnn": 0.95}, draws=20)
    assert tables["segmentation_by_method"]["maskrcnn"]["recall50"] == 0.0  # all scores are 0.9
    assert tables["segmentation_by_method"]["maskrcnn"]["ap50"] > 0.5 and "maskrcnn" not in tables["pose"]


def test_goals_stand_beside_what_was_measured(evaluated) -> None:
    truth, records = evaluated
    tables = evaluation_tables(truth, records, draws=20)
    rows = {g["name"]: g for g in tables["goals"]}
    assert len(rows) == len(GOALS["classic"]) and rows["recall at IoU 0.5"]["met"]
    assert rows["recall at IoU 0.5"]["wanted"] == "≥ 0.98 (0.998)"
    assert rows["e_x mean (mm), accepted"]["measured"] == pytest.approx(0.02) and rows["e_x mean (mm), accepted"]["met"]
    assert not rows["parts"]["met"]
    assert goals("elsewhere", 5, tables["segmentation"], tables["pose"]["tagcell"]["all"]) == []
    strict = {g.name: g for g in GOALS["classic"]}
    risky = {**tables["pose"]["tagcell"]["all"], "bad_share": 0.02}
    shares = {g["name"]: g["met"] for g in goals("classic", 5, tables["segmentation"], risky)}
    assert rows[ACCEPTED_SHARE]["met"] and not shares[ACCEPTED_SHARE]
    assert strict["wrong among accepted"].met(0.009) and not strict["wrong among accepted"].met(0.011)


def test_the_page_shows_the_papers_figures_beside_all_and_never_beside_accepted(evaluated) -> None:
    truth, records = evaluated
    text = evaluation_markdown(evaluation_tables(truth, records, draws=20))
    assert "values of its Table 1 are not available" in text
    sections = {s.splitlines()[0]: s for s in text.split("\n**") if "| part | method |" in s}
    assert len(sections) == 4
    for title, section in sections.items():
        assert ("the paper, refined" in section) is title.startswith("All that were found"), title
    assert "10.0" in text and "`pvnet-refined`, same 4 parts" in text
    for line in text.splitlines():
        if line.startswith("|"):
            assert "nan" not in line and "None" not in line


def test_latency_is_by_stage(evaluated) -> None:
    _, records = evaluated
    figures = latency_figures(records["tagcell"])
    assert set(figures) == {"thinking", "total"} and figures["thinking"] == {
        "mean": 0.5,
        "p50": 0.5,
        "p95": 0.5,
        "n": 2,
    }


def test_what_json_does_not_have_becomes_none() -> None:
    given = {1: float("nan"), "a": (np.float64(2.0), np.int64(3), [float("inf"), True])}
    assert json_ready(given) == {"1": None, "a": [2.0, 3, [None, True]]}


def test_right_answers_reach_every_goal_but_the_number_of_parts(tmp_path) -> None:
    truth = read_ground_truth(write_frames(tmp_path / "data", [LAYOUT]))
    records = evaluate(truth, {"tagcell": Told(truth.frames, right_answer)}, tmp_path / "out")
    assert [g["name"] for g in evaluation_tables(truth, records, draws=20)["goals"] if not g["met"]] == ["parts"]
