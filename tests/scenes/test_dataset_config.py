"""A config that makes no data set is refused before anything is written, and says what would."""

import json
import shutil
from typing import get_args

import pytest

from cad.parts import LIBRARY
from cad.spatial import BASLER
from scenes import dataset_config
from scenes.dataset_config import FACTORS, DatasetConfig
from scenes.errors import SceneError
from scenes.ranges import ViewRanges
from twin import render_cli


@pytest.mark.parametrize("kind", ["crop", "window"])
def test_a_pixel_is_a_whole_number_of_the_cameras(kind):
    for factor in FACTORS:
        frame = DatasetConfig(kind=kind, downscale=factor, size=(32, 32)).frame
        assert (frame.width * factor, frame.height * factor) == (BASLER.width, BASLER.height)
    with pytest.raises(SceneError, match=r"downscale 7: .* one of 1, 2, 3, 4, 6, 8"):
        DatasetConfig(kind=kind, downscale=7, size=(32, 32))


def test_the_board_is_no_farther_than_depth_images_reach():
    far = ViewRanges(height_m=(1.2, 1.4))
    assert DatasetConfig(view=far, depth=False).view_ranges == far
    with pytest.raises(SceneError, match=r"height_m up to 1\.4: depth images reach 1\.31\d* m; set depth to False"):
        DatasetConfig(view=far)


def test_a_part_is_named_once():
    with pytest.raises(SceneError, match="parts main, top, main: name each part once"):
        DatasetConfig(parts=("main", "top", "main"))


def test_parts_of_one_number_are_refused(tmp_path):
    own = shutil.copytree(LIBRARY / "main", tmp_path / "own")
    content = json.loads((own / "part.json").read_text())
    (own / "part.json").write_text(json.dumps(content | {"name": "own"}))
    config = DatasetConfig(parts=("own", "main"), parts_dir=tmp_path)
    with pytest.raises(SceneError, match=f"not own {content['obj_id']}, main {content['obj_id']}"):
        config.load_parts()
    assert [part.name for part in DatasetConfig(parts=("own", "top"), parts_dir=tmp_path).load_parts()] == [
        "own",
        "top",
    ]


@pytest.mark.parametrize("size", [(2208, 1242), (1000, 1000), (5472, 3648), (300, 900)])
def test_a_scene_is_the_middle_of_the_sensor(size):
    frame = DatasetConfig(kind="scene", size=size).frame
    scale = frame.fx / BASLER.fx
    assert scale == pytest.approx(max(size[0] / BASLER.width, size[1] / BASLER.height))
    assert frame.cx - (size[0] - 1) / 2 == pytest.approx(scale * (BASLER.cx - (BASLER.width - 1) / 2))
    assert frame.cy - (size[1] - 1) / 2 == pytest.approx(scale * (BASLER.cy - (BASLER.height - 1) / 2))


@pytest.mark.parametrize("name", ["Kind", "Domain", "Split", "Faces"])
def test_the_command_line_offers_every_choice(name):
    of_config = getattr(dataset_config, name)
    assert get_args(getattr(render_cli, name)) == get_args(of_config)
