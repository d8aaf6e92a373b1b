"""Weight files: a network's weights in safetensors, with metadata that says what they were trained on and for whom."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from cad.parts import load_part
from perception.estimates import PerceptionError

if TYPE_CHECKING:
    from perception.training import TrainingConfig, TrainingResult

StateDict = dict[str, Tensor]


def trained_with(path: Path, config: TrainingConfig) -> bool:
    """Whether a weight file was made by a run with this config."""
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = json.loads((file.metadata() or {}).get("tagcell", "{}"))
    except SafetensorError:
        return False
    return metadata.get("config") == _as_json(config)


def _as_json(config: TrainingConfig) -> dict[str, Any]:
    return json.loads(json.dumps(asdict(config), default=str))


def weights_metadata(
    part_names: Sequence[str],
    config: TrainingConfig,
    result: TrainingResult,
    data: dict[str, str],
    figures: dict[str, float],
    parts_dir: Path | None = None,
) -> dict[str, Any]:
    """What a weight file says about itself: parts with mesh hashes, command, config, data manifests, figures."""
    parts = {}
    for name in part_names:
        part = load_part(name, parts_dir)
        parts[name] = {"mesh_hash": part.mesh_hash, "stable_poses": len(part.stable_poses)}
    return {
        "parts": parts,
        "command": "python -m perception.train " + shlex.join(sys.argv[1:]),
        "config": _as_json(config),
        "minutes": round(result.minutes, 2),
        "steps": result.steps,
        "data": data,
        "figures": {key: round(float(value), 5) for key, value in figures.items()},
        "torch": torch.__version__,
    }


def save_weights(path: Path, state_dict: StateDict, metadata: dict[str, Any]) -> None:
    """Write weights (matrices and kernels as float16, the rest as it is) and metadata; a JSON copy goes beside them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {
        key: (value.half() if value.dtype.is_floating_point and value.ndim > 1 else value).contiguous()
        for key, value in state_dict.items()
    }
    aside = path.with_suffix(".part")
    save_file(tensors, str(aside), metadata={"tagcell": json.dumps(metadata)})
    os.replace(aside, path)
    path.with_suffix(".json").write_text(json.dumps(metadata, indent=2) + "\n")


def load_weights(path: Path, parts_dir: Path | None = None) -> tuple[StateDict, dict[str, Any]]:
    """Weights as float32 and their metadata.

    Raises PerceptionError when the file is missing or unreadable, or when a part's mesh or stable poses are no longer
    those the weights were trained for.
    """
    if not path.exists():
        raise PerceptionError(f"no weights at {path}; train them with `python -m perception.train {path.stem}`")
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = json.loads((file.metadata() or {}).get("tagcell", "{}"))
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a mapping)
    except SafetensorError as error:
        raise PerceptionError(f"{path} cannot be read as safetensors ({error}); train again") from error
    if "parts" not in metadata:
        raise PerceptionError(f"{path} does not say which parts it is for; train again")
    for name, stored in metadata["parts"].items():
        part = load_part(name, parts_dir)
        if (part.mesh_hash, len(part.stable_poses)) != (stored["mesh_hash"], stored["stable_poses"]):
            raise PerceptionError(
                f"{path.name} was trained for {name} with mesh {stored['mesh_hash']} and {stored['stable_poses']} "
                f"stable poses, the part now has {part.mesh_hash} and {len(part.stable_poses)}: train again"
            )
    return {key: value.float() if value.dtype.is_floating_point else value for key, value in state.items()}, metadata
