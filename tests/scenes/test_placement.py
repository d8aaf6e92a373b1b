import numpy as np
import pytest

from cad.parts import load_part
from cad.spatial import apply, inverse
from scenes.cell_config import CellConfig
from scenes.errors import SceneError
from scenes.placement import DropConfig, settle_parts

CELL = CellConfig()
NAMES = ["inserted", "main", "top", "main"]


def test_parts_lie_on_the_board_in_stable_poses_apart_and_inside_the_pick_area():
    T_board_part = inverse(CELL.T_world_board) @ settle_parts(CELL, NAMES, np.random.default_rng(5))
    parts = [load_part(name) for name in NAMES]
    centres = []
    for part, T in zip(parts, T_board_part, strict=True):
        lowest = apply(T, part.mesh.vertices)[:, 2].min()
        assert abs(lowest) < 0.03e-3
        assert max(p.R_table_part[2] @ T[2, :3] for p in part.stable_poses) > np.cos(np.radians(1.0))
        centres.append(apply(T, part.mesh.bounds.mean(axis=0))[:2])
        assert (np.abs(centres[-1]) <= CELL.pick_area_half_m).all()
    for i in range(len(parts)):
        for j in range(i):
            apart = np.linalg.norm(centres[i] - centres[j]) - parts[i].radius_m - parts[j].radius_m
            assert apart >= DropConfig().gap_m


def test_the_seed_decides_the_scene():
    first, again, other = (settle_parts(CELL, NAMES[:2], np.random.default_rng(s)) for s in (1, 1, 2))
    assert (first == again).all()
    assert not np.allclose(first, other)


def test_too_many_parts_are_refused_with_the_remedy():
    crowded = CellConfig(pick_area_half_m=(0.012, 0.012))
    with pytest.raises(SceneError, match="pick_area_half_m"):
        settle_parts(crowded, ["main"] * 4, np.random.default_rng(0))
