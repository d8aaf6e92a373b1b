"""The published baseline's networks as one ONNX file."""

import numpy as np
import onnxruntime
import torch

from perception.export import TOLERANCE, export_network
from perception.exported_networks import baseline_network
from perception.pvnet_baseline_net import Pvnets


def test_all_parts_agree_for_any_batch(tmp_path):
    weights = tmp_path / "pvnet.safetensors"
    weights.write_bytes(b"weights")
    torch.manual_seed(0)
    network = baseline_network(Pvnets({"main": 8, "top": 9}).eval(), weights)
    differences = export_network(network, tmp_path / "pvnet.onnx")
    assert list(differences) == ["main_mask", "main_vectors", "top_mask", "top_vectors"]
    session = onnxruntime.InferenceSession(str(tmp_path / "pvnet.onnx"), providers=["CPUExecutionProvider"])
    crop = np.random.default_rng(1).normal(size=(4, 5, 128, 128)).astype(np.float32)
    with torch.inference_mode():
        wanted = network.module(torch.from_numpy(crop))
    found = session.run(list(network.outputs), {"crop": crop})
    assert [a.shape for a in found] == [(4, 64, 64), (4, 4096, 8, 2), (4, 64, 64), (4, 4096, 9, 2)]
    for a, b in zip(wanted, found, strict=True):
        assert np.abs(a.numpy() - b).max() <= TOLERANCE * np.abs(a.numpy()).max()
