import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from perception.estimates import PerceptionError
from perception.maskrcnn import MaskRCNNSegmenter, paste, torchvision_module
from perception.segmentation import Detection
from perception.train import main
from perception.train_maskrcnn import best_threshold, target_of
from perception.train_segmentation import Examined
from perception.windows import Window


def disc(size: int, centre: tuple[float, float], radius: float) -> np.ndarray:
    v, u = np.mgrid[:size, :size]
    return np.hypot(u - centre[0], v - centre[1]) < radius


def window(masks: list[np.ndarray], classes: list[int]) -> Window:
    instances = np.zeros(masks[0].shape, np.uint8)
    for k, mask in enumerate(masks):
        instances[mask] = k + 1
    image = np.zeros((*instances.shape, 3), np.uint8)
    return Window(image, instances, np.zeros((len(masks), 2)), np.array(classes))


@pytest.mark.parametrize("module", ["torchvision", "torchvision.ops"])
def test_without_torchvision_the_error_says_how_to_get_it(module: str, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "torchvision", None)  # as where it is not installed
    with pytest.raises(PerceptionError, match=r"torchvision.*make maskrcnn"):
        torchvision_module(module)


def test_without_torchvision_training_ends_in_an_error_not_in_a_traceback(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setitem(sys.modules, "torchvision", None)
    assert main(["maskrcnn", "--data", str(tmp_path), "--val", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "make maskrcnn" in capsys.readouterr().err


def test_without_weights_the_error_says_how_to_train_them(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match=r"maskrcnn\.safetensors.*perception\.train maskrcnn"):
        MaskRCNNSegmenter.load(tmp_path)


@pytest.mark.parametrize("scale", [(1.0, 1.0), (4.0, 4.0), (4.02, 3.97)])
@pytest.mark.parametrize("centre", [(20.0, 22.0), (20.5, 21.7)])
def test_a_pasted_mask_lies_where_it_was_in_the_image_however_fine(
    scale: tuple[float, float], centre: tuple[float, float]
) -> None:
    cells, low, side = 28, 8.2, 26.0
    box = np.array([low, low + 1.5, low + side, low + 1.5 + side])
    # the soft mask: the disc sampled at the middles of the cells, as RoIAlign does
    middles = (np.arange(cells) + 0.5) / cells * side
    distance = np.hypot((box[0] + middles)[None] - centre[0], (box[1] + middles)[:, None] - centre[1])
    soft = np.clip(9.0 - distance + 0.5, 0, 1).astype(np.float32)
    mask, (u, v) = paste(soft, box, np.array(scale))
    fine_v, fine_u = np.nonzero(mask)
    measured = np.array([fine_u.mean() + u, fine_v.mean() + v])
    expected = (np.array(centre) + 0.5) * scale - 0.5
    assert np.abs(measured - expected).max() < 0.08 * max(scale)
    assert mask.sum() == pytest.approx(np.pi * 81 * scale[0] * scale[1], rel=0.05)


def test_a_mask_is_never_wider_than_its_box() -> None:
    box = np.array([3.5, 3.5, 11.5, 9.5])  # pixels 4 to 11 and 4 to 9
    mask, origin = paste(np.ones((28, 28), np.float32), box, np.ones(2))
    assert origin == (4, 4)
    assert mask.shape == (6, 8) and mask.all()


def test_a_box_beyond_the_border_keeps_only_what_is_in_the_image() -> None:
    mask, origin = paste(np.ones((28, 28), np.float32), np.array([-3.5, 2.5, 4.5, 6.5]), np.ones(2))
    assert origin == (0, 3)
    assert mask.shape == (4, 5) and mask.all()


def test_targets_are_boxes_round_the_pixels_and_leave_slivers_out() -> None:
    masks = [np.zeros((64, 64), bool) for _ in range(3)]
    masks[0][10:20, 5:25] = True
    masks[1][40:60, 30:42] = True
    masks[2][0:2, 50:60] = True  # 20 pixels
    target = target_of(window(masks, [2, 0, 1]))
    assert target["boxes"].tolist() == [[4.5, 9.5, 24.5, 19.5], [29.5, 39.5, 41.5, 59.5]]
    assert target["labels"].tolist() == [3, 1]
    assert np.array_equal(target["masks"].numpy().astype(bool), np.stack(masks[:2]))


def test_a_window_without_parts_has_an_empty_target() -> None:
    empty = Window(np.zeros((32, 32, 3), np.uint8), np.zeros((32, 32), np.uint8), np.zeros((0, 2)), np.zeros(0, int))
    target = target_of(empty)
    assert target["boxes"].shape == (0, 4) and target["labels"].shape == (0,) and target["masks"].shape == (0, 32, 32)


def test_pasting_a_target_back_gives_its_pixels() -> None:
    shape = disc(64, (30.0, 28.0), 14.0) & ~disc(64, (30.0, 28.0), 7.0)  # a ring: holes stay open
    target = target_of(window([shape], [0]))
    box = target["boxes"][0].numpy().astype(np.float64)
    u, v, width, height = cv2.boundingRect(shape.astype(np.uint8))
    soft = cv2.resize(shape[v : v + height, u : u + width].astype(np.float32), (28, 28))
    mask, (left, top) = paste(soft, box, np.ones(2))
    back = np.zeros_like(shape)
    back[top : top + mask.shape[0], left : left + mask.shape[1]] = mask
    assert np.count_nonzero(back & shape) > 0.93 * np.count_nonzero(back | shape)


def test_the_threshold_weighs_false_detections_and_missed_parts_alike() -> None:
    truth = window([disc(64, (20, 20), 8), disc(64, (44, 44), 8)], [0, 1])

    def found(centre: tuple[int, int], score: float) -> Detection:
        return Detection(
            centre_px=np.array(centre, float),
            score=score,
            class_probabilities=np.eye(2)[0],
            mask=disc(64, centre, 8),
            mask_origin=(0, 0),
        )

    detections = [found((20, 20), 0.9), found((44, 44), 0.62), found((10, 50), 0.4), found((50, 10), 0.2)]
    overlaps = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    area = np.array([200, 200])
    score, figures = best_threshold([Examined(truth, detections, overlaps, area, 0.1)])
    assert 0.4 < score <= 0.62
    assert figures["precision50"] == figures["recall50"] == 1.0
