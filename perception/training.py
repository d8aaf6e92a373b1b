"""The training loop that every network of ``perception`` shares.

``train`` runs a step function under a time budget: AdamW, linear warm-up and cosine decay over the budget, gradient
clipping, an exponential moving average of the weights (the one that is kept), a checkpoint every minute that a later
call resumes from, and a CSV of the curves.
"""

from __future__ import annotations

import contextlib
import csv
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from perception.estimates import PerceptionError
from perception.training_curves import VALIDATION, plot_curves
from perception.weight_files import StateDict

Losses = dict[str, Tensor]
Step = Callable[[np.random.Generator], Losses]
"""Draws a batch with the generator, runs the model, returns weighted loss terms; their sum is minimised."""
Validate = Callable[[nn.Module], dict[str, float]]


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """How long and how to train; a network's own config derives from it.

    ``minutes`` is the wall-clock budget that the learning-rate schedule spans; ``max_steps`` ends it earlier when it is
    given, and then the schedule spans the steps, so that the same seed gives the same weights.
    """

    minutes: float = 10.0
    max_steps: int | None = None
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    warmup_steps: int = 100
    gradient_norm: float = 5.0
    ema_decay: float = 0.998
    batch: int = 32
    seed: int = 0
    threads: int = 1
    checkpoint_s: float = 60.0
    validate_s: float = 180.0

    def __post_init__(self) -> None:
        for name in ("minutes", "learning_rate", "gradient_norm", "checkpoint_s", "validate_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be positive")
        for name in ("batch", "threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} = {getattr(self, name)}: must be at least 1")
        if self.max_steps is not None and self.max_steps < 1:
            raise ValueError(f"max_steps = {self.max_steps}: must be at least 1, or left out")
        if not 0.0 <= self.ema_decay < 1.0:
            raise ValueError(f"ema_decay = {self.ema_decay}: must be in [0, 1)")


@dataclass(frozen=True, kw_only=True)
class TrainingResult:
    """The averaged weights on the CPU, and what was spent on them."""

    state_dict: StateDict
    steps: int
    minutes: float


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Inside, torch draws from ``seed`` (build the model here); outside, its generators are as they were."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield


def evenly_chosen(n: int, most: int | None) -> NDArray[np.int64]:
    """Indices of ``most`` of ``n`` examples, evenly spread; of all when there are no more or no limit.

    Raises PerceptionError when none are asked for.
    """
    if most is None or most >= n:
        return np.arange(n)
    if most < 1:
        raise PerceptionError(f"{most} images to learn from: there must be at least 1 of the {n}")
    return np.round(np.linspace(0, n - 1, most)).astype(np.int64)


def learning_rate_at(config: TrainingConfig, step: int, progress: float) -> float:
    """Learning rate at a step (from 0) and a ``progress`` in [0, 1] through the budget."""
    warmup = min(1.0, (step + 1) / max(1, config.warmup_steps))
    return config.learning_rate * warmup * (0.5 * (1.0 + np.cos(np.pi * min(1.0, progress))) + 1e-3)


def train(
    name: str,
    model: nn.Module,
    step: Step,
    config: TrainingConfig,
    out_dir: Path,
    *,
    validate: Validate | None = None,
) -> TrainingResult:
    """Train ``model`` in place under the budget and return its averaged weights.

    Writes ``NAME.csv`` and ``NAME.png`` (curves) and, while it runs, ``NAME.checkpoint`` into ``out_dir``; a run that
    was cut short goes on from there when it is started again with the same config. ``validate`` gets the averaged model
    in eval mode; the time that it takes is not counted. Raises PerceptionError when the loss is no longer finite.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(config.threads)
    with seeded(config.seed):
        run = _Run(name, model, config, out_dir)
        run.resume()
        while run.progress() < 1.0:
            run.advance(step)
            if run.due("log", 15.0):
                run.log()
            if run.due("checkpoint", config.checkpoint_s):
                run.checkpoint()
            if validate is not None and run.due("validate", config.validate_s):
                run.validate(validate)
        if validate is not None:
            run.validate(validate)
        else:
            run.log()
    run.checkpoint_path.unlink(missing_ok=True)
    state = {key: value.detach().cpu().clone() for key, value in run.averaged.items()}
    return TrainingResult(state_dict=state, steps=run.steps, minutes=run.seconds / 60.0)


class _Run:
    """State of one training run: model, optimiser, averaged weights, clock and curves."""

    def __init__(self, name: str, model: nn.Module, config: TrainingConfig, out_dir: Path) -> None:
        self.name, self.model, self.config = name, model.train(), config
        self.optimizer = torch.optim.AdamW(
            model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        self.averaged: StateDict = {key: value.detach().clone() for key, value in model.state_dict().items()}
        self.rng = np.random.default_rng(config.seed)
        self.steps = 0
        self.seconds = 0.0
        self.started = time.monotonic()
        self.smooth: dict[str, float] = {}
        self.rows: list[dict[str, float]] = []
        self.last: dict[str, float] = {"log": 0.0, "checkpoint": 0.0, "validate": 0.0}
        self.checkpoint_path = out_dir / f"{name}.checkpoint"
        self.csv_path = out_dir / f"{name}.csv"

    def progress(self) -> float:
        if self.config.max_steps is not None:
            return self.steps / self.config.max_steps
        return self.seconds / (60.0 * self.config.minutes)

    def due(self, what: str, period_s: float) -> bool:
        if self.seconds - self.last[what] < period_s:
            return False
        self.last[what] = self.seconds
        return True

    def advance(self, step: Step) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate_at(self.config, self.steps, self.progress())
        losses = step(self.rng)
        total = torch.stack(list(losses.values())).sum()
        if not torch.isfinite(total):
            terms = {key: float(value) for key, value in losses.items()}
            raise PerceptionError(
                f"training {self.name}: the loss is not finite at step {self.steps} ({terms}); lower learning_rate "
                f"(now {self.config.learning_rate})"
            )
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        nn.utils.clip_grad_norm_(self.model.parameters(), self.config.gradient_norm)
        self.optimizer.step()
        self.steps += 1
        decay = min(self.config.ema_decay, self.steps / (self.steps + 9.0))
        for key, value in self.model.state_dict().items():
            average = self.averaged[key]
            if average.dtype.is_floating_point:
                average.lerp_(value.detach(), 1.0 - decay)
            else:
                average.copy_(value)
        for key, value in losses.items():
            new = float(value.detach())
            self.smooth[key] = 0.97 * self.smooth.get(key, new) + 0.03 * new
        now = time.monotonic()
        self.seconds = self.seconds + (now - self.started)
        self.started = now

    def log(self, extra: dict[str, float] | None = None) -> None:
        row: dict[str, float] = {"step": self.steps, "minutes": round(self.seconds / 60.0, 3)}
        row |= {key: round(value, 5) for key, value in {**self.smooth, **(extra or {})}.items()}
        self.rows.append(row)
        columns = list(dict.fromkeys(key for r in self.rows for key in r))
        with self.csv_path.open("w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=columns)
            writer.writeheader()
            writer.writerows(self.rows)
        done = f"{100.0 * min(1.0, self.progress()):5.1f} %"
        terms = "  ".join(f"{key} {value:.4f}" for key, value in list(row.items())[2:])
        print(f"{self.name} {done}  step {self.steps}  {self.seconds / 60.0:.1f} min  {terms}", flush=True)

    def validate(self, validate: Validate) -> None:
        live = {key: value.detach().clone() for key, value in self.model.state_dict().items()}
        self.model.load_state_dict(self.averaged)
        self.model.eval()
        with torch.no_grad():
            figures = validate(self.model)
        self.model.load_state_dict(live)
        self.model.train()
        self.log({f"{VALIDATION}{key}": value for key, value in figures.items()})
        plot_curves(self.csv_path)
        self.started = time.monotonic()

    def checkpoint(self) -> None:
        state = {
            "config": asdict(self.config),
            "model": self.model.state_dict(),
            "averaged": self.averaged,
            "optimizer": self.optimizer.state_dict(),
            "rng": self.rng.bit_generator.state,
            "torch_rng": torch.get_rng_state(),
            "steps": self.steps,
            "seconds": self.seconds,
            "smooth": self.smooth,
            "rows": self.rows,
        }
        aside = self.checkpoint_path.with_suffix(".checkpoint.part")
        torch.save(state, aside)
        os.replace(aside, self.checkpoint_path)

    def resume(self) -> None:
        if not self.checkpoint_path.exists():
            return
        state = torch.load(self.checkpoint_path, map_location="cpu", weights_only=False)
        if state["config"] != asdict(self.config):
            raise PerceptionError(
                f"{self.checkpoint_path} is of a run with another config; remove it, or start with the same config"
            )
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        for key, value in state["averaged"].items():
            self.averaged[key].copy_(value)
        self.rng.bit_generator.state = state["rng"]
        torch.set_rng_state(state["torch_rng"])
        self.steps, self.seconds = state["steps"], state["seconds"]
        self.smooth, self.rows = state["smooth"], state["rows"]
        self.last = dict.fromkeys(self.last, self.seconds)
        self.started = time.monotonic()
