import json
from functools import partial

import numpy as np
import pytest

from cad.parts import hash_file, load_part


def write_part(folder, mesh, name="brick", poses=None):
    """A part folder of ``mesh`` standing on its lowest face, read back."""
    (folder / name).mkdir()
    mesh.export(folder / name / "mesh.ply")
    height = -float(mesh.bounds[0, 2])
    poses = poses or [{"R_table_part": np.eye(3).tolist(), "t_table_part_m": [0, 0, height], "probability": 1.0}]
    info = {
        "name": name,
        "obj_id": 9,
        "mass_kg": 3e-4,
        "material": "steel",
        "rgba": [1, 1, 1, 1],
        "metallic": 1.0,
        "roughness": 0.5,
        "mesh_hash": hash_file(folder / name / "mesh.ply"),
    }
    (folder / name / "part.json").write_text(json.dumps(info))
    (folder / name / "keypoints.json").write_text(json.dumps({"keypoints_m": np.zeros((8, 3)).tolist()}))
    (folder / name / "stable_poses.json").write_text(json.dumps({"stable_poses": poses}))
    return load_part(name, folder)


@pytest.fixture
def make_part(tmp_path):
    return partial(write_part, tmp_path)
