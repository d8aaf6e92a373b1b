import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from data_sets import Picture, write_data_set

from cad.parts import BUILT_IN, load_part
from cad.spatial import BASLER, rotation_x, transform
from perception.estimates import Frame, PerceptionError
from perception.segmentation import DecodeConfig, Outputs, SegmentationNet, Segmenter, decode, normalise
from perception.train import main
from perception.train_segmentation import NO_CLASS, batch_of, examine, figures_of, focal, losses, targets_of
from perception.training import seeded
from perception.windows import Window, cut, filled, flip, paste, recolour, warp
from scenes.bop import Annotation

SIZE = 128


def draw(rng: np.random.Generator, size: int = SIZE, centres: list[tuple[float, float]] | None = None) -> Window:
    """Dark bars (class 0) and bright discs (class 1) on a noisy grey ground."""
    places = centres if centres is not None else [(32, 36), (90, 40), (60, 96)]
    image = rng.normal(120, 4, (size, size, 3))
    instances = np.zeros((size, size), np.uint8)
    classes = rng.integers(0, 2, len(places))
    for k, (u, v) in enumerate(places):
        shape = np.zeros((size, size), np.uint8)
        if classes[k]:
            cv2.circle(shape, (round(u), round(v)), 9, (1,), -1)
        else:
            box = cv2.boxPoints(((u, v), (30.0, 10.0), float(rng.uniform(0, 180))))
            cv2.fillPoly(shape, [np.round(box).astype(np.int32)], (1,))
        image[shape > 0] += 70 if classes[k] else -70
        instances[shape > 0] = k + 1
    return Window(np.clip(image, 0, 255).astype(np.uint8), instances, np.array(places, float).reshape(-1, 2), classes)


def perfect_outputs(window: Window, n_parts: int = 2) -> Outputs:
    """The logits of a network that is always right."""
    t = {key: torch.from_numpy(value)[None] for key, value in targets_of(window).items()}
    classes = torch.stack([(t["classes"] == c).float() * 20 for c in range(n_parts)], dim=1)
    heat = t["heat"].clamp(1e-6, 1 - 1e-6)
    return Outputs(
        mask=(t["mask"] - 0.5) * 40, offset_px=t["offset_px"], heat=torch.log(heat / (1 - heat)), classes=classes
    )


@pytest.mark.parametrize("seed", range(4))
def test_decoding_the_targets_gives_the_instances_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    window = warp(flip(draw(rng), rng), rng) if seed % 2 else draw(rng)
    found = decode(perfect_outputs(window), 0, DecodeConfig(), reduction=1)
    visible = [k for k in range(3) if np.count_nonzero(window.instances == k + 1) >= 60]
    assert len(found) == len(visible)
    for k in visible:
        inside = np.clip(window.centres[k], 2, SIZE - 3)
        detection = min(found, key=lambda d: float(np.linalg.norm(d.centre_px - inside)))
        assert np.linalg.norm(detection.centre_px - inside) < 0.01
        whole = np.zeros((SIZE, SIZE), bool)
        u, v = detection.mask_origin
        whole[v : v + detection.mask.shape[0], u : u + detection.mask.shape[1]] = detection.mask
        truth = window.instances == k + 1
        assert np.count_nonzero(whole & truth) > 0.97 * np.count_nonzero(whole | truth)
        assert detection.class_probabilities.argmax() == window.classes[k]


def test_stray_pixels_do_not_widen_a_mask() -> None:
    window = draw(np.random.default_rng(0), centres=[(60.0, 60.0)])
    outputs = perfect_outputs(window)
    outputs.mask[0, 75:78, 75:78] = 20.0
    outputs.offset_px[0, :, 37:39, 37:39] = -15.0
    (detection,) = decode(outputs, 0, DecodeConfig(), reduction=1)
    assert np.count_nonzero(detection.mask) == np.count_nonzero(window.instances)
    assert detection.mask.any(axis=0).all() and detection.mask.any(axis=1).all()


def test_two_equal_cells_at_a_peak_are_one_part() -> None:
    outputs = perfect_outputs(draw(np.random.default_rng(0), centres=[(60.0, 60.0)]))
    row, column = np.unravel_index(int(outputs.heat[0].argmax()), outputs.heat[0].shape)
    outputs.heat[0, row, column + 1] = outputs.heat[0, row, column]
    assert len(decode(outputs, 0, DecodeConfig(), reduction=1)) == 1


def test_parts_cut_by_the_border_are_found() -> None:
    window = draw(np.random.default_rng(0), centres=[(-2.0, 60.0), (124.0, 130.0)])
    found = decode(perfect_outputs(window), 0, DecodeConfig(), reduction=1)
    assert sorted(d.centre_px.round().astype(int).tolist() for d in found) == [[2, 60], [124, 125]]


def test_detections_are_in_frame_pixels() -> None:
    window = draw(np.random.default_rng(0), centres=[(60.0, 50.0)])
    (detection,) = decode(perfect_outputs(window), 0, DecodeConfig())
    np.testing.assert_allclose(detection.centre_px, [4 * 60.5 - 0.5, 4 * 50.5 - 0.5], atol=0.05)


@pytest.mark.parametrize("seed", range(6))
def test_variations_keep_image_map_and_centres_together(seed: int) -> None:
    """The mean of an instance's pixels stays at its centre, and discs stay brighter than bars."""
    rng = np.random.default_rng(seed)
    window = draw(rng)
    window = warp(flip(paste(window, draw(rng), rng), rng), rng)
    assert len(window.centres) == len(window.classes) >= window.instances.max()
    for k, centre in enumerate(window.centres):
        v, u = np.nonzero(window.instances == k + 1)
        if len(u) > 150 and min(u.min(), v.min()) > 0 and max(u.max(), v.max()) < SIZE - 1:
            assert np.linalg.norm([u.mean() - centre[0], v.mean() - centre[1]]) < 1.0
            assert (window.image[v, u].mean() > 85) == bool(window.classes[k])


def test_pasted_parts_never_cover_parts() -> None:
    rng = np.random.default_rng(3)
    grown = 0
    for _ in range(30):
        before = draw(rng)
        after = paste(before, draw(rng), rng)
        np.testing.assert_array_equal(after.instances[before.instances > 0], before.instances[before.instances > 0])
        grown += len(after.centres) > len(before.centres)
    assert grown > 3


@pytest.mark.parametrize("seed", range(3))
def test_a_cut_keeps_pixels_and_centres_together(seed: int) -> None:
    rng = np.random.default_rng(seed)
    window = draw(rng)
    part = cut(window, 64, rng, near=1.0)
    assert part.image.shape == (64, 64, 3)
    assert np.any(np.all((part.centres >= 0) & (part.centres < 65), axis=1))
    (du, dv), *rest = np.round(window.centres - part.centres).astype(int)
    assert all((shift == (du, dv)).all() for shift in rest)
    np.testing.assert_array_equal(part.image, window.image[dv : dv + 64, du : du + 64])
    np.testing.assert_array_equal(part.instances, window.instances[dv : dv + 64, du : du + 64])
    with pytest.raises(ValueError, match="cannot cut 200"):
        cut(window, 200, rng)


def test_what_is_seen_through_a_part_belongs_to_it_unless_it_is_another_part() -> None:
    instances = np.zeros((20, 20), np.uint8)
    instances[2:12, 2:12] = 2
    instances[4:10, 4:10] = 0
    instances[6, 6] = 1
    out = filled(instances)
    assert out[6, 6] == 1 and np.count_nonzero(out == 2) == 99 and not out[12:].any()
    np.testing.assert_array_equal(filled(out), out)


def test_normalisation_hardly_sees_exposure() -> None:
    rng = np.random.default_rng(0)
    image = recolour(draw(rng).image, rng)
    whole, half = normalise(image), normalise(image // 2)
    assert np.corrcoef(whole.ravel(), half.ravel())[0, 1] > 0.98
    assert 0.7 < half.std() / whole.std() < 1.1  # the floor of the contrast weighs more in the dark


def test_losses_of_the_truth_are_near_zero_and_empty_windows_are_allowed() -> None:
    rng = np.random.default_rng(0)
    for window in (draw(rng), draw(rng, centres=[])):
        _, targets = batch_of([window], torch.device("cpu"))
        right = losses(perfect_outputs(window), targets)
        assert all(float(right[key]) < 1e-3 for key in ("mask", "dice", "offset", "class"))
        wrong = Outputs(*(torch.zeros_like(x) for x in vars(perfect_outputs(window)).values()))
        assert float(torch.stack(list(right.values())).sum()) < float(
            torch.stack(list(losses(wrong, targets).values())).sum()
        )
        assert float(focal(torch.full((1, 4, 4), 9.0), torch.zeros(1, 4, 4))) > 1.0
    assert (targets_of(draw(rng, centres=[]))["classes"] == NO_CLASS).all()


@pytest.fixture(scope="module")
def trained() -> SegmentationNet:
    """A small network after some seconds of drawn windows."""
    rng = np.random.default_rng(0)
    with seeded(0):
        net = SegmentationNet(2, widths=(8, 16, 24, 32)).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = torch.optim.AdamW(net.parameters(), lr=1e-2)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1e-2, 70)
    for _ in range(70):
        images, targets = batch_of([flip(draw(rng), rng) for _ in range(4)], torch.device("cpu"))
        total = torch.stack(list(losses(net(images), targets).values())).sum()
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        rate.step()
    return net.eval()


def test_a_trained_network_finds_parts_at_any_exposure_in_a_frame(trained: SegmentationNet) -> None:
    segmenter = Segmenter(trained, ["bar", "disc"], DecodeConfig())
    window = draw(np.random.default_rng(9), size=200, centres=[(40.0, 50.0), (150.0, 60.0), (90.0, 150.0), (160, 150)])
    frame = np.kron(window.image[:180], np.ones((4, 4, 1), np.uint8))
    for image in (frame, (frame * 0.6).astype(np.uint8)):
        found = segmenter.detect(Frame(image=image, intrinsics=BASLER, time_s=0.0))
        assert len(found) == 4
        for k, (u, v) in enumerate(window.centres):
            nearest = min(found, key=lambda d: float(np.hypot(*(d.centre_px - [4 * u, 4 * v]))))
            assert np.hypot(*(nearest.centre_px - [4 * u + 1.5, 4 * v + 1.5])) < 12
            assert nearest.class_probabilities.argmax() == window.classes[k]


def test_figures_of_a_trained_network_on_new_windows(trained: SegmentationNet) -> None:
    rng = np.random.default_rng(7)
    examined = examine(Segmenter(trained, ["bar", "disc"], DecodeConfig()), (draw(rng) for _ in range(5)))
    figures = figures_of(examined)
    assert figures["recall50"] > 0.9 and figures["precision50"] > 0.9 and figures["class_accuracy"] > 0.9
    assert figures["centre_median_px"] < 8
    assert figures_of(examined, min_score=1.01)["recall50"] == 0.0


def write_windows(folder: Path, count: int) -> Path:
    """Drawn windows as a data set whose bars and discs pass for parts 1 and 2."""
    rng = np.random.default_rng(count)
    camera = BASLER.downscaled(4).crop(600, 400, SIZE, SIZE)
    T = transform(rotation_x(np.pi), [0.0, 0.0, 0.7])
    pictures = []
    for _ in range(count):
        window = draw(rng)
        masks = [window.instances == k + 1 for k in range(len(window.classes))]
        annotations = [
            Annotation(obj_id=int(c) + 1, stable_pose=0, T_cam_part=T, corner=(0, 0), silhouette=mask, visible=mask)
            for c, mask in zip(window.classes, masks, strict=True)
        ]
        pictures.append(Picture(window.image, camera, T, annotations))
    return write_data_set(folder, "train", [load_part(name) for name in BUILT_IN], pictures)


def test_training_from_the_command_line_leaves_weights_that_load(tmp_path: Path) -> None:
    data = ["--data", str(write_windows(tmp_path / "a", 4)), "--val", str(write_windows(tmp_path / "b", 2))]
    options = ["--max-steps", "2", "--batch", "2", "--size", "96", "--out", str(tmp_path / "out")]
    assert main(["segmentation", *data, *options]) == 0
    stored = json.loads((tmp_path / "out" / "segmentation.json").read_text())
    assert (
        stored["steps"] == 2 and set(stored["parts"]) == {"inserted", "main", "top"} and "recall50" in stored["figures"]
    )
    assert Segmenter.load(tmp_path / "out").part_names == ("inserted", "main", "top")
    assert main(["segmentation", *data, *options, "--start", str(tmp_path / "nowhere")]) == 1


def test_a_frame_that_is_too_small_is_refused(trained: SegmentationNet) -> None:
    frame = Frame(image=np.zeros((40, 400, 3), np.uint8), intrinsics=BASLER, time_s=0.0)
    with pytest.raises(PerceptionError, match="400 x 40"):
        Segmenter(trained, ["bar", "disc"], DecodeConfig()).detect(frame)


def test_thresholds_are_checked() -> None:
    with pytest.raises(ValueError, match=r"peak = 1\.5"):
        DecodeConfig(peak=1.5)
