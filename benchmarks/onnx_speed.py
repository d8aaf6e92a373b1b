"""Size of the exported networks, how far they agree with torch, and speed on one thread: a Markdown table.

Run: python -m benchmarks.onnx_speed [--weights DIR] [--repeats N]

Inputs are as large as one 20 MP frame's: the whole reduced frame for the segmenter, four turns of three crops for the
classifier, four views of three crops for the verifier, three crops for keypoints and baseline. Times are milliseconds
of processor time of this process, so what else runs matters little; the fastest of the repeats. torch is run as the
estimator runs it (bfloat16 where it is autocast) and in float32, onnxruntime in float32.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnxruntime
import torch

from perception.estimator import WEIGHTS
from perception.export import Exportable, Inputs, export_all
from perception.exported_networks import exportable_networks

BATCHES = {"classifier": 12, "verifier": 12, "keypoints": 3, "pvnet": 3}
FRAME = (1, 3, 912, 1376)
"""A quarter of 5472 x 3648, padded to multiples of 16."""


def inputs_of(network: Exportable) -> Inputs:
    if network.name == "segmentation":
        return {"image": torch.randn(FRAME)}
    batch = BATCHES[network.name]
    made = {"crop": torch.randn(batch, *network.example["crop"].shape[1:])}
    return made | ({"face": torch.zeros(batch, dtype=torch.int64)} if "face" in network.inputs else {})


def milliseconds(run: Callable[[], Any], repeats: int) -> float:
    run()
    times = []
    for _ in range(repeats):
        started = time.process_time()
        run()
        times.append(time.process_time() - started)
    return 1e3 * min(times)


def torch_ms(network: Exportable, inputs: Inputs, repeats: int, reduced: bool) -> float:
    module = network.module.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    values = [v.contiguous(memory_format=torch.channels_last) if v.ndim == 4 else v for v in inputs.values()]
    autocast = torch.autocast("cpu", torch.bfloat16) if reduced else contextlib.nullcontext()
    with torch.inference_mode(), autocast:
        return milliseconds(lambda: module(*values), repeats)


def onnx_ms(path: Path, inputs: Inputs, repeats: int) -> float:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    feed = {name: value.numpy() for name, value in inputs.items()}
    return milliseconds(lambda: session.run(None, feed), repeats)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    networks = exportable_networks(arguments.weights)
    with tempfile.TemporaryDirectory() as folder:
        manifest = export_all(networks, Path(folder))
        print("| file | MB | largest difference | torch bfloat16 ms | torch float32 ms | onnxruntime float32 ms |")
        print("|---|---|---|---|---|---|")
        for network in networks:
            entry, inputs = manifest[network.name], inputs_of(network)
            reduced = torch_ms(network, inputs, arguments.repeats, reduced=True)
            full = torch_ms(network, inputs, arguments.repeats, reduced=False)
            onnx = onnx_ms(Path(folder) / entry["file"], inputs, arguments.repeats)
            worst = max(entry["differences"].values())
            print(
                f"| `{entry['file']}` | {entry['bytes'] / 1e6:.1f} | {worst:.1e} | {reduced:.0f} | {full:.0f} "
                f"| {onnx:.0f} |"
            )


if __name__ == "__main__":
    main()
