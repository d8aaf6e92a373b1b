"""One scene in every image domain and in Blender's Cycles: time an image, and the pictures side by side."""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import load_part, planar
from cad.spatial import BASLER, Intrinsics, apply, inverse, rotation_x, transform
from scenes.camera import camera_pose
from scenes.domains import DOMAINS, Domain, domain_problem
from scenes.environments import make_environments
from scenes.randomize import DEFAULT_LAMPS, Look
from scenes.ranges import LookRanges
from scenes.render import ALL
from scenes.scene_export import DrawnLamp, SceneDescription, SceneReader, environment_panorama, texture_image
from scenes.shots import Placed, Shot
from scenes.stage import Stage, StageConfig
from scenes.workers import one_core

SIZE = 256
PHYSICAL: tuple[Domain, ...] = ("filament", "mitsuba", "classic")
"""Domains by what a scene is exported as: lamps with a place and a size, and surroundings, where they work."""
SAMPLES, BOUNCES, THREADS = 64, 6, 2
PART, PLACE_M, YAW = "main", (0.020, 0.0725), 0.6
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
    """One part on the board beside a tag's corner, far from the camera's axis, under one lamp that casts shadows."""

    def __init__(self) -> None:
        self._part = load_part(PART)
        T_board_part = planar(*PLACE_M, YAW) @ self._part.stable_poses[0].T_table_part
        T_board_cam = transform(rotation_x(np.pi), [0.0, 0.0, 0.70])
        u, v = BASLER.project(apply(inverse(T_board_cam), [*PLACE_M, 0.0]))
        self._shot = Shot(
            intrinsics=BASLER.crop(round(u) - SIZE // 2, round(v) - SIZE // 2, SIZE, SIZE),
            downscale=1,
            T_board_cam=T_board_cam,
            focus_board=PLACE_M,
            parts=(Placed(name=PART, T_board_object=T_board_part, stable_pose=0),),
            distractors=(),
        )

    def stage(self, domain: Domain) -> Stage:
        """A stage on which the scene is set; close it when done."""
        rng = np.random.default_rng(0)
        config = StageConfig(slots=1, max_size=(SIZE, SIZE), shadow_half_m=0.025, shadow_size=1024)
        stage = Stage([self._part], [], config, domain=domain, environments=make_environments(rng, 1))
        stage.arrange(self._shot)
        lamp = replace(DEFAULT_LAMPS[0], rgb=(0.6, 0.6, 0.6), radius_m=0.02)
        stage.dress(self._shot, Look(lamps=(lamp,), ambient=0.35, environment=0, default=True), LookRanges(), rng)
        return stage

    def draw(self, domain: Domain, images: int) -> Drawn:
        """Draw the scene in one domain, with labels, ``images`` times."""
        started = time.process_time()
        with closing(self.stage(domain)) as stage:
            drawn = stage.render(self._shot.intrinsics, ALL)
            first_s = time.process_time() - started
            times = [_cpu_s(lambda: stage.render(self._shot.intrinsics, ALL)) for _ in range(images)]
        assert drawn.instances is not None
        cpu_s = float(np.median(times))
        mask, rate = drawn.instances >= 0, THREADS / cpu_s
        return Drawn(name=domain, cpu_ms=1e3 * cpu_s, rate=rate, first_s=first_s, picture=drawn.picture, mask=mask)

    def export(self, folder: Path, images: int) -> None:
        """Write the scene, as a physically based domain has it, for ``blender_scene.py``."""
        domain = next(d for d in PHYSICAL if d == "classic" or not domain_problem(d))
        with closing(self.stage(domain)) as stage:
            _write_scene(SceneReader(stage.model).read(stage.data), stage, self._shot.intrinsics, images, folder)

    def draw_with_blender(self, python: Path, images: int) -> Drawn:
        """Draw the scene with Cycles under an interpreter that has bpy; raises RuntimeError with what it printed."""
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            self.export(folder, images)
            done = subprocess.run([python, STANDALONE, folder], capture_output=True, text=True, check=False)
            if done.returncode or not (folder / "times.json").exists():
                raise RuntimeError(f"{python} {STANDALONE.name} failed:\n{done.stdout[-800:]}\n{done.stderr[-1600:]}")
            times = json.loads((folder / "times.json").read_text())
            read = {name: cv2.imread(str(folder / f"{name}.png")) for name in ("cycles", "mask")}
        if read["cycles"] is None or read["mask"] is None:
            raise RuntimeError(f"{python} {STANDALONE.name} left no pictures:\n{done.stdout[-800:]}")
        cpu_s = float(np.median(times["cpu_s"]))
        return Drawn(
            name=f"Cycles {times['version']}",
            cpu_ms=1e3 * cpu_s,
            rate=THREADS / cpu_s,
            first_s=times["prepared_s"] + times["first_s"],
            picture=cv2.cvtColor(read["cycles"], cv2.COLOR_BGR2RGB).view(np.uint8),
            mask=read["mask"][..., 0] > 127,
        )


def compare(images: int, blender: Path | None) -> list[Drawn]:
    """The scene in every domain that works here, and in Cycles when there is an interpreter for it."""
    scene = SharedScene()
    few = max(2, images // 10)
    with one_core("mitsuba"):
        drawn = [scene.draw(d, few if d == "mitsuba" else images) for d in DOMAINS if not domain_problem(d)]
    if blender is not None:
        drawn.append(scene.draw_with_blender(blender, few))
    return drawn


def overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks."""
    return float((a & b).sum() / max((a | b).sum(), 1))


def strip(drawn: list[Drawn], zoom: int = 2) -> NDArray[np.uint8]:
    """The pictures side by side (H, W, 3), each with its name."""
    tiles = []
    for one in drawn:
        tile = cv2.resize(one.picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
        cv2.putText(tile, one.name, (6, tile.shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(tile, one.name, (6, tile.shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255,) * 3, 1, cv2.LINE_AA)
        tiles.append(tile)
    return np.hstack(tiles).astype(np.uint8)


def _write_scene(scene: SceneDescription, stage: Stage, intrinsics: Intrinsics, images: int, folder: Path) -> None:
    """``scene.json`` and the arrays that it names."""
    geoms, used = [], sorted({g.finish.texture for g in scene.geoms if g.finish.texture >= 0})
    for texture in used:
        np.savez(folder / f"texture_{texture}.npz", colours=texture_image(stage.model, texture))
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
        panorama = environment_panorama(stage.model, scene.environment) * np.float32(scene.environment_radiance)
        np.savez(folder / "environment.npz", colours=np.roll(panorama, panorama.shape[1] // 4, axis=1))
    content: dict[str, Any] = {
        "camera": _camera(intrinsics) | {"T_world_cam": camera_pose(stage.model, stage.data).tolist()},
        "geoms": geoms,
        "part": "part_00_visual",
        "lamps": [_lamp(lamp) for lamp in scene.lamps if any(lamp.rgb)],
        "ambient": scene.ambient,
        "environment": "environment.npz" if scene.environment >= 0 else "",
        "samples": SAMPLES,
        "bounces": BOUNCES,
        "threads": THREADS,
        "images": images,
    }
    (folder / "scene.json").write_text(json.dumps(content))


def _cpu_s(draw: Callable[[], object]) -> float:
    before = time.process_time()
    draw()
    return time.process_time() - before


def _camera(intrinsics: Intrinsics) -> dict[str, Any]:
    i = intrinsics
    return {"width": i.width, "height": i.height, "f": i.fx, "cx": i.cx, "cy": i.cy}


def _lamp(lamp: DrawnLamp) -> dict[str, Any]:
    return asdict(lamp) | {"position": lamp.position.tolist(), "direction": lamp.direction.tolist()}
