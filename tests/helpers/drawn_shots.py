"""Many shots at once, and where their things lie."""

import numpy as np

from cad.spatial import apply, inverse
from scenes.dataset_config import DatasetConfig
from scenes.distractors import distractors

SCENE = DatasetConfig(kind="scene")


def shots(draw, count, seed=0):
    rng = np.random.default_rng(seed)
    return [draw(rng) for _ in range(count)]


def frames(sampler, count, seed=0, config=SCENE):
    return shots(lambda rng: sampler.frame(rng, config.frame, config.scale_down), count, seed)


def footprint(placed, parts):
    """Centre (2,) of a thing's bounding rectangle seen from above, and radius of the circle round it."""
    if placed.stable_pose < 0:
        return placed.T_board_object[:2, 3], distractors()[placed.name].radius_m
    corners = apply(placed.T_board_object, parts[placed.name].mesh.convex_hull.vertices)[:, :2]
    listed = parts[placed.name].stable_poses[placed.stable_pose].T_table_part  # tilts move it by micrometres
    centre = (placed.T_board_object @ inverse(listed))[:2, 3]
    return centre, np.linalg.norm(corners - centre, axis=1).max()
