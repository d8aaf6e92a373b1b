"""The trained networks as ONNX files, each checked against torch, for machines that run no Python or no torch.

Every file takes any batch, the segmentation any image size, too. What goes in and comes out is described in
``networks.json`` beside them, with the parts and faces that class numbers mean; the files hold the same as metadata.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cad.files import replacing, write_json
from cad.parts import hash_file
from perception.estimates import PerceptionError

TOLERANCE = 1e-3
"""Largest difference between torch and ONNX in float32, over the largest magnitude of the same output."""
MANIFEST = "networks.json"
METADATA = "tagcell"

Inputs = dict[str, Tensor]
Axes = dict[str, dict[int, Any]]


class ExportError(PerceptionError):
    """Networks that cannot be exported, or come out different."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Exportable:
    """A network and all that its file should say.

    ``module`` takes the tensors of ``example``, by name and in order, and returns one or a tuple of those named in
    ``outputs``. ``sizes`` are further inputs, of other batches and sizes, on which the file is compared with torch;
    ``axes`` are the input axes that may change, after ``torch.onnx.export``. ``weights`` is the file it comes from.
    """

    name: str
    module: nn.Module
    weights: Path
    example: Inputs
    sizes: tuple[Inputs, ...]
    axes: Axes
    inputs: dict[str, str]
    outputs: dict[str, str]
    about: dict[str, Any] = field(default_factory=dict)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's remarks on what does not concern these networks."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def runtime() -> ModuleType:
    """The package onnxruntime; raises ExportError that tells how to install it."""
    try:
        import onnx  # noqa: F401
        import onnxruntime
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ExportError(f"{error.name} is not installed; run: pip install 'tagcell[onnx]'") from error
    return onnxruntime


def export_network(network: Exportable, path: Path) -> dict[str, float]:
    """Write one network as ONNX and return, for each output, how much it differs from torch (see ``TOLERANCE``).

    The file appears only when it agrees; raises ExportError when it does not, or when packages are missing.
    """
    runtime()
    net = network.module.eval()
    with _quiet():
        program = torch.onnx.export(
            net,
            tuple(network.example.values()),
            input_names=list(network.example),
            output_names=list(network.outputs),
            dynamic_shapes=tuple(network.axes[name] for name in network.example),
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    assert program is not None
    program.model.metadata_props[METADATA] = json.dumps(_description(network))
    with replacing(path) as temporary:
        program.save(temporary)
        differences = compare(network, temporary)
        worst = max(differences, key=lambda name: differences[name])
        if not differences[worst] <= TOLERANCE:
            raise ExportError(
                f"{network.name}: output {worst} differs from torch's by {differences[worst]:.2g} of its largest "
                f"value, more than {TOLERANCE}; try another version of onnxruntime, or train again"
            )
    return differences


def compare(network: Exportable, path: Path) -> dict[str, float]:
    """For each output the largest difference between torch and the file, over the largest magnitude torch gives.

    Both in float32, on the example and on all ``sizes``; the worst of them counts.
    """
    session = runtime().InferenceSession(str(path), providers=["CPUExecutionProvider"])
    worst = dict.fromkeys(network.outputs, 0.0)
    for inputs in (network.example, *network.sizes):
        with torch.inference_mode():
            wanted = network.module(*inputs.values())
        wanted = wanted if isinstance(wanted, tuple) else (wanted,)
        found = session.run(list(network.outputs), {name: value.numpy() for name, value in inputs.items()})
        for name, a, b in zip(network.outputs, wanted, found, strict=True):
            a = a.numpy()
            if a.shape != b.shape:
                raise ExportError(f"{network.name}: output {name} has shape {b.shape} instead of torch's {a.shape}")
            difference = float(np.abs(a - b).max() / max(float(np.abs(a).max()), 1e-12))
            worst[name] = max(worst[name], difference) if np.isfinite(difference) else float("inf")
    return worst


def export_all(
    networks: Sequence[Exportable], out: Path, progress: Callable[[str], None] | None = None
) -> dict[str, dict[str, Any]]:
    """Write ``out/NAME.onnx`` for each network and ``out/networks.json``; returns what the latter holds."""
    manifest: dict[str, dict[str, Any]] = {}
    for network in networks:
        if progress is not None:
            progress(network.name)
        path = out / f"{network.name}.onnx"
        differences = export_network(network, path)
        manifest[network.name] = {
            "file": path.name,
            "bytes": path.stat().st_size,
            "hash": hash_file(path),
            "differences": differences,
            **_description(network),
        }
    write_json(out / MANIFEST, manifest)
    return manifest


def _description(network: Exportable) -> dict[str, Any]:
    return {
        "inputs": network.inputs,
        "outputs": network.outputs,
        "weights": {"file": network.weights.name, "hash": hash_file(network.weights)},
        **network.about,
    }
