"""Labels of an image: whole silhouettes whatever hides or cuts a part, at no cost where nothing does; keypoints."""

import numpy as np
import pytest

from cad.parts import load_part, planar
from cad.spatial import BASLER, apply, inverse, rotation_x, transform
from scenes.annotations import Labeller, seen_keypoints
from scenes.layout import Placed
from scenes.lens import STRAIGHT, Lens
from scenes.shots import Shot
from scenes.stage import Stage, StageConfig

T_BOARD_CAM = transform(rotation_x(np.pi) @ rotation_x(0.02), [0.003, -0.002, 0.7])
SIZE = 256
BLOCK = "block_0"
"""A distractor of 9 x 7 x 3 mm."""
LENS = Lens(k1=-0.08, k2=0.05, p1=0.001, p2=-0.002)


@pytest.fixture(scope="module")
def stage():
    config = StageConfig(slots=3, max_size=(2 * SIZE, 2 * SIZE), shadow_half_m=0.025, shadow_size=512)
    stage = Stage([load_part("main"), load_part("top")], [], config)
    yield stage
    stage.close()


@pytest.fixture(autouse=True)
def pinhole(stage):
    stage.lens = STRAIGHT
    yield
    stage.lens = STRAIGHT


def window_round(x, y, size=SIZE):
    u, v = BASLER.project(apply(inverse(T_BOARD_CAM), [x, y, 0.001]))
    return BASLER.crop(round(u) - size // 2, round(v) - size // 2, size, size)


def resting(name, x, y, yaw=0.3, face=0, lift=0.0):
    pose = load_part(name).stable_poses[face]
    T = transform(t=[0, 0, lift]) @ planar(x, y, yaw) @ pose.T_table_part
    return Placed(name=name, stable_pose=face, T_board_object=T)


def block(x, y, lift=0.01):
    """Above the board, so that it hides what is below it."""
    return Placed(name=BLOCK, T_board_object=transform(t=[0, 0, lift]) @ planar(x, y, 0.5))


def shot_of(parts, distractors=(), intrinsics=None):
    return Shot(
        intrinsics=intrinsics or window_round(0.0, 0.0),
        downscale=1,
        T_board_cam=T_BOARD_CAM,
        focus_board=(0.0, 0.0),
        parts=tuple(parts),
        distractors=tuple(distractors),
    )


def label(stage, shot):
    instances = stage.arrange(shot)
    drawn = stage.render(shot.intrinsics, ("instances", "depth"))
    return Labeller(stage).label(shot, instances, drawn), drawn, instances


def drawn_alone(stage, shot, k, margin=200):
    """The part's pixels in a window that is larger by ``margin``, of a shot that holds nothing else."""
    alone = shot_of([shot.parts[k]], intrinsics=shot.intrinsics)
    instance = stage.arrange(alone)[0]
    w = shot.intrinsics
    pieces = [
        [stage.render(w.crop(x, y, margin, margin), ("instances",)).instances == instance for x in steps]
        for steps in [range(-margin, w.width + margin, margin)]
        for y in steps
    ]
    return np.block(pieces)


def whole_of(annotation, shape, margin=200):
    """The annotation's silhouette in the same larger window."""
    canvas = np.zeros((shape[0] + 2 * margin, shape[1] + 2 * margin), bool)
    (x, y), (h, w) = annotation.corner, annotation.silhouette.shape
    canvas[y + margin : y + margin + h, x + margin : x + margin + w] = annotation.silhouette
    return canvas


def assert_whole(stage, shot, found, k):
    """The silhouette equals the part drawn alone, and its pixels are right within the image."""
    alone = drawn_alone(stage, shot, k)
    shape = (shot.intrinsics.height, shot.intrinsics.width)
    canvas = whole_of(found, shape)
    rows, columns = min(alone.shape[0], canvas.shape[0]), min(alone.shape[1], canvas.shape[1])
    assert np.array_equal(canvas[:rows, :columns], alone[:rows, :columns])
    assert np.array_equal(found.mask(shape), alone[200 : 200 + shape[0], 200 : 200 + shape[1]])


def test_parts_by_themselves_are_labelled_without_drawing_them_again(stage, monkeypatch):
    parts = [resting("main", -0.006, 0.0), resting("top", 0.007, 0.002, face=1)]
    shot = shot_of(parts, intrinsics=window_round(0.0, 0.0, 400))
    instances = stage.arrange(shot)
    drawn = stage.render(shot.intrinsics, ("instances", "depth"))
    labeller = Labeller(stage)
    with monkeypatch.context() as patched:
        patched.setattr(stage, "render", lambda *_: pytest.fail("a part was drawn again"))
        found = labeller.label(shot, instances, drawn)
    assert [a.obj_id for a in found] == [2, 3] and [a.stable_pose for a in found] == [0, 1]
    for k, annotation in enumerate(found):
        assert np.array_equal(annotation.mask_visible((400, 400)), drawn.instances == instances[k])
        assert np.array_equal(annotation.silhouette, annotation.visible) and annotation.visible.sum() > 1000
        expected = inverse(T_BOARD_CAM) @ shot.parts[k].T_board_object
        np.testing.assert_allclose(annotation.T_cam_part, expected, atol=1e-12)
        assert_whole(stage, shot, annotation, k)


@pytest.mark.parametrize("lens", [STRAIGHT, LENS], ids=["pinhole", "distorted"])
def test_what_hides_a_part_does_not_change_its_silhouette(stage, lens):
    stage.lens = lens
    shot = shot_of([resting("main", 0.0, 0.0)], [block(0.004, 0.003)])
    found, drawn, instances = label(stage, shot)
    mask, visible = found[0].mask((SIZE, SIZE)), found[0].mask_visible((SIZE, SIZE))
    assert np.array_equal(visible, drawn.instances == instances[0])
    assert 0.2 < visible.sum() / mask.sum() < 0.9
    assert_whole(stage, shot, found[0], 0)


@pytest.mark.parametrize("lens", [STRAIGHT, LENS], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("place", [(0.009, 0.0), (-0.008, 0.008), (0.0, -0.0085)])
def test_what_the_border_cuts_is_told_whole(stage, place, lens):
    stage.lens = lens
    shot = shot_of([resting("top", *place, yaw=1.0), resting("main", 0.0, 0.0)])
    found, _, _ = label(stage, shot)
    (x, y), (h, w) = found[0].corner, found[0].silhouette.shape
    assert x < 0 or y < 0 or x + w > SIZE or y + h > SIZE
    assert 0 < found[0].visible.sum() < found[0].silhouette.sum()
    assert_whole(stage, shot, found[0], 0)
    assert_whole(stage, shot, found[1], 1)


def test_a_part_that_is_larger_than_the_image_is_told_whole(stage):
    shot = shot_of([resting("main", 0.0, 0.0)], intrinsics=window_round(0.001, 0.0, 64))
    found, _, _ = label(stage, shot)
    assert found[0].mask((64, 64)).mean() > 0.5
    assert found[0].silhouette.sum() > 2 * 64 * 64
    assert_whole(stage, shot, found[0], 0)


def test_hidden_parts_are_listed_and_those_beyond_the_image_are_not(stage):
    hidden = resting("top", 0.0, 0.0, lift=-0.008)
    shot = shot_of([resting("main", 0.05, 0.0), hidden, resting("main", 0.0, 0.0, lift=0.0)], [block(0.0, 0.0)])
    found, _, _ = label(stage, shot)
    assert [a.obj_id for a in found] == [3, 2]
    assert not found[0].visible.any() and found[0].mask((SIZE, SIZE)).sum() > 1000
    assert (found[0].keypoints[:, 2] == 1).all()


def test_labelling_leaves_the_stage_as_it_was(stage):
    shot = shot_of([resting("main", 0.009, 0.0), resting("top", 0.0, 0.0)], [block(0.003, 0.003)])
    _, before, _ = label(stage, shot)
    after = stage.render(shot.intrinsics, ("instances", "depth"))
    assert np.array_equal(before.instances, after.instances) and np.array_equal(before.depth_m, after.depth_m)


@pytest.mark.parametrize("lens", [STRAIGHT, LENS], ids=["pinhole", "distorted"])
def test_keypoints_are_where_the_lens_shows_them(stage, lens):
    stage.lens = lens
    shot = shot_of([resting("main", 0.002, 0.001)])
    found, drawn, _ = label(stage, shot)
    part = load_part("main")
    p_cam = apply(found[0].T_cam_part, part.keypoints)
    np.testing.assert_allclose(found[0].keypoints[:, :2], lens.project(shot.intrinsics, p_cam), atol=1e-9)
    for (u, v, flag), z in zip(found[0].keypoints, p_cam[:, 2], strict=True):
        nearest = drawn.depth_m[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2]
        if flag == 2:
            assert nearest.max() > z - 2e-4
        else:
            assert nearest.min() < z - 5e-5
    assert {1.0, 2.0} == set(found[0].keypoints[:, 2])


def test_keypoints_are_hidden_by_what_is_nearer_and_by_the_border():
    camera = BASLER.crop(2700, 1800, 20, 20)
    points = camera.rays([[10.0, 10.0], [10.0, 10.0], [10.0, 10.0], [3.2, 4.7], [19.6, 5.0], [-0.4, 5.0]])
    points *= np.array([0.7, 0.7005, 0.69, 0.7, 0.69, 0.69])[:, None]
    depth = np.full((20, 20), 0.7, np.float32)
    depth[3:8, 2:6] = 0.6
    depth[4, 3] = 0.70005
    seen = seen_keypoints(points, camera, depth)
    assert seen[:, 2].tolist() == [2, 1, 2, 2, 1, 2]
    np.testing.assert_allclose(seen[3, :2], [3.2, 4.7])
