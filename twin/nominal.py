"""The calibration that the drawing of the cell gives, for a cell whose true one was not measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scenes.cell_config import CellConfig
from twin.attempts import Calibration

EDGE_M = 0.005
"""Parts may lie this far over the edge of the pick area and are still picked."""


def nominal_calibration(cell: CellConfig, parts: Sequence[str]) -> Calibration:
    """Board, nests and parking pose as drawn. Raises SceneError for a part that the tray has no nests for."""
    return Calibration(
        T_base_board=cell.T_world_board,
        T_base_nests={name: cell.nest_frames(name) for name in parts},
        q_park=np.array(cell.home_q),
        board_half_m=(cell.pick_area_half_m[0] + EDGE_M, cell.pick_area_half_m[1] + EDGE_M),
    )
