"""One scene in every image domain and in Blender's Cycles: time an image, and the pictures side by side."""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import load_part, planar
from cad.spatial import BASLER, Intrinsics, apply, inverse, rotation_x, transform
from scenes.camera import camera_pose
from scenes.domains import DOMAINS, Domain, domain_problem, make_renderer
from scenes.randomize import LookRanges, draw_look
from scenes.scene_export import DrawnLamp, SceneReader, environment_panorama, texture_image
from scenes.shots import Placed, Shot
from scenes.stage import Stage, StageConfig

SIZE = 256
SAMPLES, BOUNCES, THREADS = 64, 6, 2
PART, PLACE_M, YAW = "main", (0.031, -0.018), 0.6
STANDALONE = Path(__file__).with_name("blender_scene.py")


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """What one renderer made of the scene: CPU ms an image, images/s on two cores, picture, the part's mask.

    ``first_s`` is what the first image takes: compiling, building and uploading.
    """

    name: str
    cpu_ms: float
    rate: float
    first_s: float
    picture: NDArray[np.uint8]
    mask: NDArray[np.bool_]


class SharedScene:
    """One part on the board beside a tag's corner, off the camera's axis, lit by the pick cell's lamps."""

    def __init__(self, environments: int = 1) -> None:
        ranges = LookRanges(default_look=1.0)
        rng = np.random.default_rng(0)
        T_board_cam = transform(rotation_x(np.pi), [0.0, 0.0, 0.70])
        part = load_part(PART)
        T_board_part = planar(*PLACE_M, YAW) @ part.stable_poses[0].T_table_part
        u, v = BASLER.project(apply(inverse(T_board_cam), [*PLACE_M, 0.0]))
        self.intrinsics = BASLER.crop(round(u) - SIZE // 2, round(v) - SIZE // 2, SIZE, SIZE)
        shot = Shot(
            intrinsics=self.intrinsics,
            downscale=1,
            T_board_cam=T_board_cam,
            focus_board=PLACE_M,
            parts=(Placed(name=PART, T_board_object=T_board_part, stable_pose=0),),
            distractors=(),
        )
        config = StageConfig(slots=1, max_size=(SIZE, SIZE), shadow_half_m=0.025, shadow_size=1024)
        stage = Stage([part], [], config)
        self.instance = int(stage.arrange(shot)[0])
        stage.dress(shot, draw_look(ranges, 0, rng), ranges, rng)
        stage.close()
        self.model, self.data = stage.model, stage.data

    def draw(self, domain: Domain, images: int) -> Drawn:
        """Draw the scene in one domain, with labels, ``images`` times."""
        started = time.process_time()
        renderer = make_renderer(domain, self.model, max_width=SIZE, max_height=SIZE)
        try:
            drawn = renderer.render(self.data, self.intrinsics)
            first_s = time.process_time() - started
            times = [_cpu_s(lambda: renderer.render(self.data, self.intrinsics)) for _ in range(images)]
        finally:
            renderer.close()
        assert drawn.instances is not None
        cpu_s = float(np.median(times))
        mask = drawn.instances == self.instance
        rate = THREADS / cpu_s
        return Drawn(name=domain, cpu_ms=1e3 * cpu_s, rate=rate, first_s=first_s, picture=drawn.picture, mask=mask)

    def export(self, folder: Path, images: int) -> None:
        """Write the scene for ``blender_scene.py``."""
        scene = SceneReader(self.model).read(self.data)
        geoms, used = [], sorted({g.finish.texture for g in scene.geoms if g.finish.texture >= 0})
        for texture in used:
            np.savez(folder / f"texture_{texture}.npz", colours=texture_image(self.model, texture))
        for geom in scene.geoms:
            arrays = {"vertices": geom.mesh.vertices, "normals": geom.mesh.normals, "faces": geom.mesh.faces}
            if geom.mesh.texcoords is not None:
                arrays["texcoords"] = geom.mesh.texcoords
            np.savez(folder / f"geom_{geom.geom}.npz", **arrays)
            finish = geom.finish
            geoms.append(
                {
                    "name": geom.name,
                    "mesh": f"geom_{geom.geom}.npz",
                    "T_world_geom": geom.T_world_geom.tolist(),
                    "rgb": np.clip(finish.rgb, 0, 1).tolist(),
                    "metallic": finish.metallic,
                    "roughness": finish.roughness,
                    "texture": f"texture_{finish.texture}.npz" if finish.texture >= 0 else "",
                    "repeat": finish.repeat,
                }
            )
        if scene.environment >= 0:
            panorama = environment_panorama(self.model, scene.environment) * np.float32(scene.environment_radiance)
            np.savez(folder / "environment.npz", colours=np.roll(panorama, panorama.shape[1] // 4, axis=1))
        content: dict[str, Any] = {
            "camera": _camera(self.intrinsics) | {"T_world_cam": camera_pose(self.model, self.data).tolist()},
            "geoms": geoms,
            "part": f"part_{self.instance:02d}_visual",
            "lamps": [_sun(lamp) for lamp in scene.lamps if any(lamp.rgb)],
            "ambient": scene.ambient,
            "environment": "environment.npz" if scene.environment >= 0 else "",
            "samples": SAMPLES,
            "bounces": BOUNCES,
            "threads": THREADS,
            "images": images,
        }
        (folder / "scene.json").write_text(json.dumps(content))

    def draw_with_blender(self, python: Path, images: int) -> Drawn:
        """Draw the scene with Cycles under an interpreter that has bpy; raises RuntimeError with what it printed."""
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            self.export(folder, images)
            done = subprocess.run([python, STANDALONE, folder], capture_output=True, text=True, check=False)
            if done.returncode or not (folder / "times.json").exists():
                raise RuntimeError(f"{python} {STANDALONE.name} failed:\n{done.stdout[-800:]}\n{done.stderr[-1600:]}")
            times = json.loads((folder / "times.json").read_text())
            picture = cv2.cvtColor(cv2.imread(str(folder / "cycles.png")), cv2.COLOR_BGR2RGB)
            mask = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE) > 127
        cpu_s = float(np.median(times["cpu_s"]))
        return Drawn(
            name=f"Cycles {times['version']}",
            cpu_ms=1e3 * cpu_s,
            rate=THREADS / cpu_s,
            first_s=times["prepared_s"] + times["first_s"],
            picture=picture.astype(np.uint8),
            mask=mask,
        )


def compare(images: int, blender: Path | None) -> list[Drawn]:
    """The scene in every domain that works here, and in Cycles when there is an interpreter for it."""
    scene = SharedScene()
    few = max(2, images // 10)
    drawn = [scene.draw(d, few if d == "mitsuba" else images) for d in DOMAINS if not domain_problem(d)]
    if blender is not None:
        drawn.append(scene.draw_with_blender(blender, few))
    return drawn


def overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks."""
    return float((a & b).sum() / max((a | b).sum(), 1))


def strip(drawn: list[Drawn], zoom: int = 1) -> NDArray[np.uint8]:
    """The pictures side by side (H, W, 3), each with its name."""
    tiles = []
    for one in drawn:
        tile = cv2.resize(one.picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
        cv2.putText(tile, one.name, (6, tile.shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(tile, one.name, (6, tile.shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255,) * 3, 1, cv2.LINE_AA)
        tiles.append(tile)
    return np.hstack(tiles).astype(np.uint8)


def _cpu_s(draw: Callable[[], object]) -> float:
    before = time.process_time()
    draw()
    return time.process_time() - before


def _camera(intrinsics: Intrinsics) -> dict[str, Any]:
    i = intrinsics
    return {"width": i.width, "height": i.height, "f": i.fx, "cx": i.cx, "cy": i.cy}


def _sun(lamp: DrawnLamp) -> dict[str, Any]:
    """A directional lamp; Blender's shines along its own -z."""
    z = -lamp.direction / np.linalg.norm(lamp.direction)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    return {"rgb": lamp.rgb, "angle": 0.0, "T_world_lamp": T.tolist()}
