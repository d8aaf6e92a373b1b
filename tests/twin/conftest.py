import json
import shutil
from functools import partial

import numpy as np
import pytest
import trimesh

from cad.parts import hash_file, load_part
from twin.grasp_config import GraspConfig
from twin.grasps import write_grasps


def write_part(folder, mesh, name="brick", poses=None, pieces=None):
    """A part folder of ``mesh`` standing on its lowest face, read back; ``pieces`` touch, by default its hull."""
    (folder / name).mkdir()
    mesh.export(folder / name / "mesh.ply")
    (folder / name / "hulls").mkdir()
    for k, piece in enumerate(pieces or [mesh.convex_hull]):
        piece.export(folder / name / "hulls" / f"{k:03d}.ply")
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


@pytest.fixture(scope="session")
def planned_brick(tmp_path_factory):
    """A box of 8 x 6 x 3 mm with its grasps, planned once; not to be changed."""
    part = write_part(tmp_path_factory.mktemp("planned"), trimesh.creation.box([8e-3, 6e-3, 3e-3]))
    write_grasps(part, GraspConfig(sample_spacing_m=0.2e-3, yaw_step=np.pi / 6, enough=6))
    return part


@pytest.fixture
def brick(make_part, planned_brick):
    """A box of 8 x 6 x 3 mm with its grasps."""
    part = make_part(trimesh.creation.box([8e-3, 6e-3, 3e-3]))
    shutil.copy(planned_brick.folder / "grasps.json", part.folder)
    return part
