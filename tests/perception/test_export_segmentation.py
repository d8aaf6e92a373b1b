"""The segmentation network as ONNX: any batch, any size in steps of 16."""

import numpy as np
import onnxruntime
import torch

from perception.export import TOLERANCE, export_network
from perception.exported_networks import segmentation_network
from perception.segmentation import SegmentationNet


def test_segmentation_agrees_at_any_batch_and_size(tmp_path):
    (tmp_path / "segmentation.safetensors").write_bytes(b"weights")
    torch.manual_seed(0)
    network = segmentation_network(SegmentationNet(3), ["inserted", "main", "top"], tmp_path)
    differences = export_network(network, tmp_path / "segmentation.onnx")
    assert set(differences) == {"mask", "offset_px", "heat", "classes"}
    session = onnxruntime.InferenceSession(str(tmp_path / "segmentation.onnx"), providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(1)
    for shape in ((1, 3, 16, 16), (4, 3, 112, 80)):
        image = rng.normal(size=shape).astype(np.float32)
        with torch.inference_mode():
            wanted = network.module(torch.from_numpy(image))
        for a, b in zip(wanted, session.run(list(network.outputs), {"image": image}), strict=True):
            assert a.shape == b.shape
            assert np.abs(a.numpy() - b).max() <= TOLERANCE * np.abs(a.numpy()).max()
