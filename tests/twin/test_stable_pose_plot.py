import io
import json

import cv2
import numpy as np
import pytest
import trimesh
from rich.console import Console

from cad.parts import load_part
from cad.spatial import rotation_x, rotation_y
from scenes.stable_poses import StablePoseConfig, canonical_rotation
from twin.stable_pose_plot import _spread, plot_stable_poses
from twin.stable_pose_report import print_stable_poses, roll_and_elevation_deg, roll_deg, stable_pose_report


@pytest.fixture(scope="module")
def report():
    return stable_pose_report(load_part("main"), StablePoseConfig(drops=120, threads=2, min_probability=0.02))


def test_roll_is_the_turn_about_x_that_the_part_was_given():
    for angle in (-2.5, 0.0, 0.4, 3.0):
        roll, elevation = roll_and_elevation_deg((rotation_x(angle) @ np.eye(3))[2])
        assert roll == pytest.approx(np.degrees(angle))
        assert elevation == pytest.approx(0.0, abs=1e-9)
    _, elevation = roll_and_elevation_deg(rotation_y(-0.5)[2])
    assert elevation == pytest.approx(np.degrees(0.5))


def test_a_pose_upside_down_has_a_roll_of_180_and_one_on_end_has_none(report):
    rolls = [roll_deg(pose) for pose in report.result.poses]
    for pose, roll in zip(report.result.poses, rolls, strict=True):
        up = pose.R_table_part[2]
        if abs(up[0]) > 0.99:
            assert roll is None
        elif up[2] < -0.99:
            assert roll == pytest.approx(180.0, abs=0.1)
    assert None in rolls and any(roll is not None for roll in rolls)
    np.testing.assert_allclose(canonical_rotation(np.array([0.0, 0.0, 1.0])), np.eye(3))


def test_the_interval_holds_the_probability_and_narrows_with_the_drops(report):
    widths = []
    for pose in report.result.poses:
        low, high = report.interval(pose)
        assert low < pose.probability < high
        widths.append((high - low) / np.sqrt(pose.probability * (1 - pose.probability)))
    assert max(widths) < 2.5 * 1.96 / np.sqrt(120)


def test_the_table_names_every_pose_and_both_sources_of_probability(report):
    page = io.StringIO()
    print_stable_poses(report, Console(file=page, width=80, highlight=False))
    text = page.getvalue()
    assert "…" not in text
    for pose in report.result.poses:
        assert f"{pose.probability:.3f}" in text and f"{report.result.quasi_static[pose.index]:.3f}" in text
    assert "120 drops: 0 unsettled" in text
    assert f"total variation between drops and quasi-static probabilities: {report.result.total_variation:.3f}" in text


def test_the_report_as_json_holds_every_settled_drop(report):
    document = json.loads(json.dumps(report.as_json()))
    settled = document["settled"]
    assert len(settled["roll_deg"]) == len(settled["stable_pose"]) == len(settled["x_elevation_deg"]) == 120
    shares = np.bincount(np.array(settled["stable_pose"]) + 1, minlength=5)[1:] / 120
    for pose in document["stable_poses"]:
        assert shares[pose["index"]] == pytest.approx(pose["probability"])
        assert pose["probability_lower_95"] < pose["probability"] < pose["probability_upper_95"]


def test_a_written_report_is_read_back_with_the_part(report, make_part, tmp_path):
    part = make_part(trimesh.creation.box((8e-3, 6e-3, 3e-3)))
    assert part.stable_poses[0].view_equivalents is None
    stable_pose_report(part, StablePoseConfig(drops=60, threads=2)).write()
    stored = load_part("brick", tmp_path).stable_poses
    assert sum(pose.probability for pose in stored) > 0.9
    assert all(pose.view_equivalents for pose in stored)


def test_the_plot_shows_a_bar_in_each_poses_colour(report, tmp_path):
    path = tmp_path / "main.png"
    plot_stable_poses(report, path)
    image = cv2.imread(str(path))
    assert image is not None and image.shape[1] == 900
    assert path.stat().st_size < 150_000
    for colour in ((0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00), (0x00, 0x9E, 0x73)):
        assert (image[..., ::-1] == colour).all(axis=-1).sum() > 100


@pytest.mark.parametrize("places", [[], [0.0], [0.0, 9.9], [-90.0, 0.0, 90.0, 180.0], [170.0, 180.0, 190.0], [0.0] * 9])
def test_pictures_stand_side_by_side_inside_the_plot(places):
    middles = _spread(places, (-185.0, 195.0))
    assert len(middles) == len(places)
    pitch = min(66.0, 380.0 / max(1, len(places)))
    assert all(np.diff(middles) >= pitch - 1e-6)
    assert all(-185 + pitch / 2 - 1e-6 <= m <= 195 - pitch / 2 + 1e-6 for m in middles)
