"""`tagcell render` and `tagcell data`: settings, recipes, one clear line for what is wrong, progress."""

import io
import json

import pytest
from painted import PaintedMaker
from rich.console import Console

from scenes.dataset_config import DatasetConfig
from scenes.generate import Progress
from scenes.recipes import load_recipe, recipe_names
from twin.cli import main
from twin.render_cli import Render
from twin.render_progress import describe, image_progress

SMALL = ["--size", "32x32", "--downscale", "4", "--count", "6", "--shard", "4", "--jobs", "1"]


@pytest.fixture
def painted(monkeypatch):
    """Quick images."""
    monkeypatch.setattr("scenes.workers.ImageMaker", PaintedMaker)


def fails(capsys, *arguments):
    with pytest.raises(SystemExit) as stopped:
        main(list(arguments))
    captured = capsys.readouterr()
    return stopped.value.code, " ".join((captured.out + captured.err).replace("│", " ").split())


def test_a_data_set_is_rendered_and_told_to_people_and_machines(painted, tmp_path, capsys):
    main(["render", *SMALL, "--out", str(tmp_path / "data")])
    captured = capsys.readouterr()
    assert captured.out.strip().startswith(f"{tmp_path / 'data'}: 6 images in 2 shards; instances seen: inserted 5, ")
    main(["render", *SMALL, "--out", str(tmp_path / "data"), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert told["images"] == 6 and told["out"] == str(tmp_path / "data")
    assert json.loads((tmp_path / "data" / "manifest.json").read_text()).items() <= told.items()


def test_options_make_the_config():
    render = Render(
        kind="window",
        part=("top", "main"),
        domain="filament",
        split="test",
        instances=7,
        seed=3,
        size="64x48",
        downscale=2,
        faces="uniform",
        jpeg=90,
        no_depth=True,
        shard=9,
    )
    assert render.config() == DatasetConfig(
        kind="window",
        parts=("top", "main"),
        domain="filament",
        split="test",
        count=None,
        instances=7,
        seed=3,
        size=(64, 48),
        downscale=2,
        faces="uniform",
        jpeg=90,
        depth=False,
        shard=9,
    )
    assert Render().config() == DatasetConfig()


def test_a_recipe_gives_the_config_and_what_contradicts_it_is_refused(capsys, tmp_path):
    assert Render(recipe="val_crops").config() == load_recipe("val_crops")
    assert Render(recipe="val_crops", split="val", count=1500).config() == load_recipe("val_crops")
    code, text = fails(capsys, "render", "--recipe", "val_crops", "--seed", "5", "--out", str(tmp_path / "data"))
    assert code == 1 and text.startswith("tagcell: --seed 5 contradicts recipe 'val_crops', whose seed is 2")
    code, text = fails(capsys, "render", "--recipe", "cake")
    assert code == 1 and "recipe 'cake' is not one of" in text and "val_crops" in text


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ("--size 256", 1, "--size '256': give width and height in pixels, like 256x256"),
        ("--size 8x8", 1, "size 8 x 8: must be from 32 x 32 to"),
        ("--part gizmo", 1, "no part is called 'gizmo'; parts there are: inserted, main, top"),
        ("--domain blender", 2, "--domain"),
        ("--kind movie", 2, "--kind"),
        ("--jobs 0", 1, "jobs 0: must be at least 1"),
        ("--count 0", 1, "count 0: must be at least 1"),
        ("--count 5 --instances 5", 1, "--count 5 and --instances 5: give one of them"),
        ("--instances 0", 1, "instances 0: must be at least 1"),
        ("--jpeg 101", 1, "jpeg 101"),
        ("--shard 5000", 1, "shard 5000"),
        ("--kind scene --downscale 2", 1, "downscale 2: a scene is scaled to its size"),
    ],
)
def test_wrong_options_end_in_one_clear_line(capsys, tmp_path, arguments, code, said):
    found, text = fails(capsys, "render", *arguments.split(), "--out", str(tmp_path / "data"))
    assert found == code and said in text
    assert code == 2 or text.startswith(f"tagcell: {said}")
    assert not (tmp_path / "data").exists()


def test_recipes_are_listed_for_people_and_machines(capsys):
    main(["data", "recipes"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == recipe_names()
    main(["data", "recipes", "--json"])
    assert json.loads(capsys.readouterr().out)["val_crops"]["count"] == 1500


def test_a_folder_without_a_data_set_is_no_valid_one(capsys, tmp_path):
    code, text = fails(capsys, "data", "validate", str(tmp_path))
    assert code == 1 and text.startswith(f"tagcell: {tmp_path} holds no images")


def test_damage_makes_the_check_fail_and_names_the_remedy(painted, capsys, tmp_path):
    main(["render", *SMALL, "--out", str(tmp_path / "data")])
    capsys.readouterr()
    (tmp_path / "data" / "train" / "000001" / "rgb" / "000000.png").write_bytes(b"rubbish")
    code, text = fails(capsys, "data", "validate", str(tmp_path / "data"), "--sample", "0", "--json")
    problems = json.loads(text)["problems"]
    (found,) = (p for p in problems if "was changed" in json.dumps(p))
    assert code == 1 and "delete" in json.dumps(found) and "render again" in json.dumps(found)


@pytest.mark.parametrize("verb", ["render", "data", "data validate", "data sheet", "data recipes"])
def test_help_fits_80_columns(capsys, monkeypatch, verb):
    monkeypatch.setenv("COLUMNS", "80")
    code, text = fails(capsys, *verb.split(), "--help")
    assert code == 0 and text.startswith(f"usage: tagcell {verb}")
    with pytest.raises(SystemExit):
        main([*verb.split(), "--help"])
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


def test_progress_is_one_line_on_a_terminal_and_plain_lines_elsewhere(monkeypatch):
    monkeypatch.setattr("twin.render_progress.EVERY_S", 0.0)
    for terminal in (True, False):
        stream = io.StringIO()
        with image_progress("crops", Console(file=stream, force_terminal=terminal, width=100)) as report:
            report(Progress(done=150, total=250, made=50, seconds=10.0))
        written = stream.getvalue()
        assert ("\x1b" in written) == terminal
        if not terminal:
            assert written == "crops: 150 of 250 images, 5 images/s, 0:00:20 left\n"
    assert describe(Progress(done=0, total=250, made=0, seconds=3.0)) == "0 of 250 images"
