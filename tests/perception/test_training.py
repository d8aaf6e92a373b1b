from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from perception import training, weight_files
from perception.estimates import PerceptionError
from perception.train import main, trainer
from perception.training import TrainingConfig, TrainingResult, evenly_chosen, learning_rate_at, seeded, train
from perception.weight_files import load_weights, save_weights, trained_with, weights_metadata


@dataclass(frozen=True)
class FakePart:
    mesh_hash: str = "0123456789abcdef"
    stable_poses: tuple[int, ...] = (0, 1, 2)


@pytest.fixture
def part(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weight_files, "load_part", lambda name, parts_dir=None: FakePart())


def regression(seed: int) -> tuple[nn.Module, training.Step]:
    """A linear fit of y = 2 x0 - x1."""
    with seeded(seed):
        model = nn.Sequential(nn.Linear(2, 4), nn.BatchNorm1d(4), nn.Linear(4, 1))

    def step(rng: np.random.Generator) -> training.Losses:
        x = torch.from_numpy(rng.normal(size=(32, 2))).float()
        return {"square": ((model(x)[:, 0] - 2 * x[:, 0] + x[:, 1]) ** 2).mean()}

    return model, step


CONFIG = TrainingConfig(max_steps=200, learning_rate=3e-2, warmup_steps=10, ema_decay=0.9, seed=3)


def test_training_lowers_the_loss_and_writes_curves(tmp_path: Path) -> None:
    model, step = regression(3)
    before = step(np.random.default_rng(0))["square"].item()
    result = train("toy", model, step, CONFIG, tmp_path, validate=lambda m: {"training": float(m.training)})
    assert result.steps == 200
    assert step(np.random.default_rng(0))["square"].item() < 0.1 * before
    header, *rows = (tmp_path / "toy.csv").read_text().splitlines()
    assert header == "step,minutes,square,val_training" and rows[-1].endswith(",0.0")
    assert not (tmp_path / "toy.checkpoint").exists()


def test_same_seed_same_weights_and_the_global_generator_is_left_alone(tmp_path: Path) -> None:
    before = torch.get_rng_state()
    a, b = (train("toy", *regression(3), CONFIG, tmp_path).state_dict for _ in range(2))
    assert all(torch.equal(a[key], b[key]) for key in a)
    assert torch.equal(torch.get_rng_state(), before)


def test_a_run_that_was_cut_short_ends_where_an_unbroken_one_does(tmp_path: Path) -> None:
    config = TrainingConfig(max_steps=60, checkpoint_s=1e-9, warmup_steps=10, seed=1)
    whole = train("toy", *regression(1), config, tmp_path / "whole").state_dict
    model, step = regression(1)
    calls = 0

    def failing(rng: np.random.Generator) -> training.Losses:
        nonlocal calls
        calls += 1
        if calls == 31:
            raise KeyboardInterrupt
        return step(rng)

    with pytest.raises(KeyboardInterrupt):
        train("toy", model, failing, config, tmp_path / "cut")
    resumed = train("toy", *regression(99), config, tmp_path / "cut")
    assert resumed.steps == 60
    assert all(torch.allclose(whole[key], resumed.state_dict[key], atol=1e-7) for key in whole)


def test_a_checkpoint_of_another_config_is_refused(tmp_path: Path) -> None:
    def interrupted(rng: np.random.Generator) -> training.Losses:
        raise KeyboardInterrupt

    model, step = regression(1)
    config = TrainingConfig(max_steps=2, checkpoint_s=1e-9)
    run = training._Run("toy", model, config, tmp_path)
    run.advance(step)
    run.checkpoint()
    with pytest.raises(PerceptionError, match="another config"):
        train("toy", model, interrupted, TrainingConfig(max_steps=3), tmp_path)


def test_learning_rate_warms_up_and_falls() -> None:
    rates = [learning_rate_at(CONFIG, step, step / 200) for step in range(200)]
    assert rates[0] < 0.2 * CONFIG.learning_rate and max(rates) < 1.01 * CONFIG.learning_rate
    assert rates[-1] < 0.01 * CONFIG.learning_rate
    assert np.all(np.diff(rates[10:]) < 0)


def test_a_loss_that_is_not_finite_says_what_to_do(tmp_path: Path) -> None:
    model, _ = regression(0)
    with pytest.raises(PerceptionError, match="lower learning_rate"):
        train("toy", model, lambda rng: {"a": torch.tensor(torch.nan)}, CONFIG, tmp_path)


@pytest.mark.parametrize("bad", [{"minutes": 0.0}, {"batch": 0}, {"ema_decay": 1.0}, {"max_steps": 0}])
def test_bad_config_names_the_field(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        TrainingConfig(**bad)  # pyright: ignore[reportArgumentType]


def weights_file(tmp_path: Path) -> Path:
    model, _ = regression(0)
    result = TrainingResult(state_dict=model.state_dict(), steps=5, minutes=0.1)
    metadata = weights_metadata(["main"], CONFIG, result, {"data": "abc"}, {"recall": 0.5})
    save_weights(tmp_path / "toy.safetensors", result.state_dict, metadata)
    return tmp_path / "toy.safetensors"


@pytest.mark.usefixtures("part")
def test_weights_come_back_with_their_metadata(tmp_path: Path) -> None:
    path = weights_file(tmp_path)
    state, metadata = load_weights(path)
    model, _ = regression(0)
    assert metadata["figures"] == {"recall": 0.5} and metadata["config"]["max_steps"] == 200
    for key, value in model.state_dict().items():
        assert state[key].dtype == value.dtype
        assert torch.allclose(state[key], value, rtol=1e-3, atol=1e-4)


@pytest.mark.usefixtures("part")
def test_weights_of_another_mesh_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = weights_file(tmp_path)
    monkeypatch.setattr(weight_files, "load_part", lambda name, parts_dir=None: FakePart(mesh_hash="other"))
    with pytest.raises(PerceptionError, match="train again"):
        load_weights(path)


@pytest.mark.usefixtures("part")
def test_weights_know_the_config_that_made_them(tmp_path: Path) -> None:
    path = weights_file(tmp_path)
    assert trained_with(path, CONFIG)
    assert not trained_with(path, replace(CONFIG, seed=4))
    path.write_bytes(b"nonsense")
    assert not trained_with(path, CONFIG)


def test_curves_become_a_picture(tmp_path: Path) -> None:
    model, step = regression(3)
    train("toy", model, step, CONFIG, tmp_path, validate=lambda m: {"training": float(m.training)})
    picture = cv2.imread(str(tmp_path / "toy.png"))
    assert picture is not None and picture.shape[0] > 100 and picture.std() > 1.0


def test_missing_and_broken_weights_are_named(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match=r"no weights at .*toy\.safetensors"):
        load_weights(tmp_path / "toy.safetensors")
    (tmp_path / "toy.safetensors").write_bytes(b"nonsense")
    with pytest.raises(PerceptionError, match="cannot be read"):
        load_weights(tmp_path / "toy.safetensors")


def test_command_line_names_the_networks(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["nonesuch"]) == 1
    assert "segmentation" in capsys.readouterr().err
    with pytest.raises(PerceptionError, match="nonesuch"):
        trainer("nonesuch")


def test_fewer_images_are_evenly_chosen() -> None:
    np.testing.assert_array_equal(evenly_chosen(9, 5), [0, 2, 4, 6, 8])
    np.testing.assert_array_equal(evenly_chosen(4, None), range(4))
    np.testing.assert_array_equal(evenly_chosen(4, 99), range(4))
    assert len(set(evenly_chosen(1000, 333).tolist())) == 333
    with pytest.raises(PerceptionError, match="0 images to learn from"):
        evenly_chosen(4, 0)
