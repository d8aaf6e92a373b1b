from pathlib import Path

import numpy as np
import pytest
import torch

from cad.spatial import wrap_angle
from perception.classifier import JointClassifier
from perception.estimates import PerceptionError
from perception.faces import FaceTable
from perception.posenets import PoseNets
from perception.pvnet import PVNet
from perception.training import TrainingConfig, TrainingResult
from perception.verifier import Verifier
from perception.weight_files import save_weights, weights_metadata

TABLE = FaceTable.load()
CROPS = np.random.default_rng(0).integers(0, 255, (3, 128, 128, 3), dtype=np.uint8)
RAYS = np.zeros((3, 2))


@pytest.fixture(scope="module")
def nets() -> PoseNets:
    torch.manual_seed(0)
    return PoseNets(TABLE, JointClassifier(len(TABLE)), Verifier(len(TABLE)), PVNet.for_table(TABLE))


def test_hypotheses_are_sorted_and_of_known_faces(nets: PoseNets) -> None:
    readings = nets.hypotheses(CROPS, RAYS, count=4)
    assert len(readings) == 3
    for reading in readings:
        scores = [h.log_probability for h in reading.hypotheses]
        assert len(scores) == 4 and scores == sorted(scores, reverse=True)
        assert sum(reading.class_probabilities.values()) == pytest.approx(1.0)
        assert 0.0 <= reading.not_a_part <= 1.0
        assert all(TABLE.index_of(h.part, h.stable_pose) >= 0 for h in reading.hypotheses)


def test_verifying_keeps_the_hypotheses_adds_the_verifiers_own_and_sorts_by_the_sum(nets: PoseNets) -> None:
    before = nets.hypotheses(CROPS, RAYS)
    after = nets.verify(CROPS, RAYS, before)
    for a, b in zip(before, after, strict=True):
        proposed = {(h.part, h.stable_pose, h.yaw) for h in a.hypotheses}
        added = [h for h in b.hypotheses if (h.part, h.stable_pose, h.yaw) not in proposed]
        assert len(b.hypotheses) == len(proposed) + len(added)
        assert len(added) <= 1
        for h in added:
            assert h.verifier == max(other.verifier for other in b.hypotheses)
            assert h.classifier < min(other.classifier for other in a.hypotheses)
        scores = [h.classifier + h.verifier for h in b.hypotheses]
        assert scores == sorted(scores, reverse=True) and all(h.verifier < 0 for h in b.hypotheses)


def test_keypoints_by_both_kinds_of_votes(nets: PoseNets) -> None:
    faces = [("main", 0), ("top", 1), ("inserted", 2)]
    by_offset = nets.keypoints(CROPS, RAYS, faces)
    by_ransac = nets.keypoints(CROPS, RAYS, faces, np.random.default_rng(0))
    for found in by_offset + by_ransac:
        assert found.pixels.shape == (8, 2) and found.covariances.shape == (8, 2, 2)
        assert (np.linalg.eigvalsh(found.covariances) > 0).all()
    with pytest.raises(PerceptionError, match="no face"):
        nets.keypoints(CROPS, RAYS, [("main", 99)] * 3)


def test_no_crops_give_no_answers_and_wrong_crops_an_error(nets: PoseNets) -> None:
    none = np.zeros((0, 128, 128, 3), np.uint8)
    assert nets.hypotheses(none, np.zeros((0, 2))) == [] and nets.verify(none, np.zeros((0, 2)), []) == []
    with pytest.raises(PerceptionError, match=r"expected \(N, 128, 128, 3\)"):
        nets.hypotheses(np.zeros((1, 256, 256, 3), np.uint8), RAYS[:1])


def save(nets: PoseNets, folder: Path) -> None:
    result = TrainingResult(state_dict={}, steps=1, minutes=0.1)
    names = [part.name for part in TABLE.parts]
    metadata = weights_metadata(names, TrainingConfig(), result, {}, {}) | {"faces": TABLE.describe()}
    for name, net in (("classifier", nets.classifier), ("verifier", nets.verifier), ("keypoints", nets.votes)):
        save_weights(folder / f"{name}.safetensors", net.state_dict(), metadata)


def test_saved_weights_answer_alike_and_are_refused_for_other_stable_poses(nets: PoseNets, tmp_path: Path) -> None:
    save(nets, tmp_path)
    loaded = PoseNets.load(tmp_path)
    a, b = nets.hypotheses(CROPS, RAYS)[0], loaded.hypotheses(CROPS, RAYS)[0]
    assert [h.part for h in a.hypotheses] == [h.part for h in b.hypotheses]
    assert abs(float(wrap_angle(a.hypotheses[0].yaw - b.hypotheses[0].yaw))) < 0.02
    assert all((tmp_path / f"{n}.safetensors").stat().st_size < 3e6 for n in ("classifier", "verifier", "keypoints"))
    described = TABLE.describe()
    described[0], described[1] = described[1] | {"stable_pose": 0}, described[0] | {"stable_pose": 1}
    with pytest.raises(PerceptionError, match="train again"):
        TABLE.check(described, "weights")


def test_missing_weights_are_named(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match=r"no weights at .*classifier"):
        PoseNets.load(tmp_path)
