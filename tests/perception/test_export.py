"""Crop networks as ONNX: what onnxruntime computes is what torch computes, for any batch."""

import json
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from cad.parts import BUILT_IN
from perception.classifier import JointClassifier
from perception.export import MANIFEST, METADATA, TOLERANCE, ExportError, compare, export_all, export_network
from perception.exported_networks import crop_networks
from perception.faces import FaceTable
from perception.posenets import PoseNets
from perception.pvnet import PVNet
from perception.verifier import Verifier


@pytest.fixture(scope="module")
def networks(tmp_path_factory):
    """Crop networks with random weights, by name."""
    folder = tmp_path_factory.mktemp("weights")
    for name in ("classifier", "verifier", "keypoints"):
        (folder / f"{name}.safetensors").write_bytes(name.encode())
    torch.manual_seed(0)
    table = FaceTable.load(BUILT_IN)
    nets = PoseNets(table, JointClassifier(len(table)), Verifier(len(table)), PVNet.for_table(table))
    return {network.name: network for network in crop_networks(nets, folder)}


@pytest.fixture(scope="module")
def exported(networks, tmp_path_factory):
    folder = tmp_path_factory.mktemp("onnx")
    said: list[str] = []
    manifest = export_all(list(networks.values()), folder, said.append)
    assert said == list(networks)
    return folder, manifest


@pytest.mark.parametrize("name", ["classifier", "verifier", "keypoints"])
def test_a_file_computes_what_its_network_computes(networks, exported, name):
    folder, manifest = exported
    network = networks[name]
    session = onnxruntime.InferenceSession(str(folder / manifest[name]["file"]), providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(1)
    for batch in (1, 5):  # neither is a batch that the export has seen
        feed = {"crop": rng.normal(size=(batch, *network.example["crop"].shape[1:])).astype(np.float32)}
        if "face" in network.inputs:
            feed["face"] = rng.integers(11, size=batch)
        with torch.inference_mode():
            wanted = network.module(*(torch.from_numpy(value) for value in feed.values()))
        found = session.run(list(network.outputs), feed)
        for a, b in zip(wanted if isinstance(wanted, tuple) else (wanted,), found, strict=True):
            assert a.shape == b.shape
            assert np.abs(a.numpy() - b).max() <= TOLERANCE * np.abs(a.numpy()).max()


def test_the_manifest_says_what_goes_in_and_comes_out(networks, exported):
    folder, manifest = exported
    assert json.loads((folder / MANIFEST).read_text()) == manifest
    for name, entry in manifest.items():
        model = onnx.load(folder / entry["file"])
        assert [i.name for i in model.graph.input] == list(entry["inputs"])
        assert [o.name for o in model.graph.output] == list(entry["outputs"])
        assert entry["bytes"] == (folder / entry["file"]).stat().st_size
        assert all(0 <= difference <= TOLERANCE for difference in entry["differences"].values())
        stored = json.loads({p.key: p.value for p in model.metadata_props}[METADATA])
        assert stored["faces"] == entry["faces"]
        faces = [(face["part"], face["stable_pose"]) for face in entry["faces"]]
        assert faces == [(f.part.name, f.stable_pose.index) for f in FaceTable.load(BUILT_IN).faces], name
    assert sorted(p.name for p in folder.iterdir()) == sorted([MANIFEST, *(e["file"] for e in manifest.values())])


def test_a_file_of_other_weights_is_told(networks, exported):
    folder, _ = exported
    network = networks["verifier"]
    head = network.module.head[-1].bias
    with torch.no_grad():
        kept = head.clone()
        head += 0.5
    try:
        assert max(compare(network, folder / "verifier.onnx").values()) > 10 * TOLERANCE
    finally:
        with torch.no_grad():
            head.copy_(kept)
    assert max(compare(network, folder / "verifier.onnx").values()) <= TOLERANCE


def test_a_network_that_comes_out_different_leaves_no_file(networks, monkeypatch, tmp_path):
    monkeypatch.setattr("perception.export.compare", lambda *_: {"logits": 0.5})
    monkeypatch.setattr("torch.onnx.export", lambda *_, **__: _Program())
    with pytest.raises(ExportError, match=r"verifier: output logits differs from torch's by 0\.5"):
        export_network(networks["verifier"], tmp_path / "verifier.onnx")
    assert not list(tmp_path.iterdir())


class _Program:
    def __init__(self) -> None:
        self.model = type("Model", (), {"metadata_props": {}})()

    def save(self, path: Path) -> None:
        Path(path).write_bytes(b"x")


def test_without_the_packages_the_error_says_how_to_install_them(networks, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ExportError, match=r"pip install 'tagcell\[onnx\]'"):
        export_network(networks["verifier"], tmp_path / "verifier.onnx")
