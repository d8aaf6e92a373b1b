"""BOP's results file there and back, and files that are not in its form."""

import numpy as np
import pytest

from cad.spatial import rotation_from_rotvec, transform
from perception.bop_results import BopPose, bop_results_name, read_bop_results, write_bop_results
from perception.estimates import PerceptionError

IDENTITY = "1 0 0 0 1 0 0 0 1"


def poses(n: int) -> list[BopPose]:
    rng = np.random.default_rng(0)
    return [
        BopPose(
            scene_id=k // 4,
            im_id=k // 2,
            obj_id=1 + k % 3,
            score=float(rng.uniform()),
            T_cam_part=transform(rotation_from_rotvec(rng.normal(size=3)), [*rng.normal(0, 0.05, 2), 0.7]),
            time_s=1.5 + k // 2,
        )
        for k in range(n)
    ]


def test_what_is_written_is_read(tmp_path) -> None:
    path, given = tmp_path / "bop" / "m.csv", poses(12)
    write_bop_results(path, given)
    assert path.read_text().splitlines()[0] == "scene_id,im_id,obj_id,score,R,t,time"
    found = read_bop_results(path)
    assert len(found) == len(given)
    for a, b in zip(given, found, strict=True):
        assert (a.scene_id, a.im_id, a.obj_id, a.score, a.time_s) == (b.scene_id, b.im_id, b.obj_id, b.score, b.time_s)
        np.testing.assert_allclose(a.T_cam_part, b.T_cam_part, rtol=0, atol=1e-15)


def test_lengths_are_in_millimetres_and_rotations_row_by_row(tmp_path) -> None:
    T = transform(rotation_from_rotvec([0.0, 0.0, np.pi / 2]), [0.01, -0.02, 0.7])
    write_bop_results(tmp_path / "m.csv", [BopPose(scene_id=0, im_id=3, obj_id=2, score=0.5, T_cam_part=T)])
    line = (tmp_path / "m.csv").read_text().splitlines()[1].split(",")
    assert line[:4] == ["0", "3", "2", "0.5"] and line[6] == "-1.0"
    np.testing.assert_allclose(np.array(line[4].split(), float), [0, -1, 0, 1, 0, 0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.array(line[5].split(), float), [10.0, -20.0, 700.0])


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        (f"0,0,1,0.5,{IDENTITY},0 0 0.7,1", "millimetre"),
        ("0,0,1,0.5,1 0 0 0 1 0 0 0 -1,0 0 700,1", "no rotation"),
        ("0,0,1,0.5,1 0 0,0 0 700,1", "9 and 3"),
        (f"0,0,1,{IDENTITY},0 0 700,1", "columns"),
        (f"0,x,1,0.5,{IDENTITY},0 0 700,1", "line 3"),
        (f"0,0,1,0.5,{IDENTITY},0 0 700,2", "whole image"),
    ],
)
def test_lines_that_are_not_bop_are_named(tmp_path, line, wrong) -> None:
    path = tmp_path / "m.csv"
    path.write_text(f"scene_id,im_id,obj_id,score,R,t,time\n0,0,1,0.9,{IDENTITY},0 0 700,1\n{line}\n")
    with pytest.raises(PerceptionError, match=wrong):
        read_bop_results(path)


def test_other_files_are_errors(tmp_path) -> None:
    (tmp_path / "m.csv").write_text("a,b\n")
    with pytest.raises(PerceptionError, match="no BOP results"):
        read_bop_results(tmp_path / "m.csv")
    with pytest.raises(PerceptionError, match="cannot be read"):
        read_bop_results(tmp_path / "none.csv")


def test_names_follow_bops_rule() -> None:
    assert bop_results_name("pvnet_refined", "tagcell", "test") == "pvnet-refined_tagcell-test.csv"
