"""What each row of a contact sheet varies: one range from its low to its high end, all others at their middle."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import Part, planar
from cad.spatial import BASLER, Array, apply, inverse
from cad.tagboard import TagboardConfig
from scenes.lens import STRAIGHT, Lens
from scenes.randomize import Look, camera_above, draw_look, draw_sensor
from scenes.ranges import LensRanges, LookRanges, SensorRanges, ViewRanges
from scenes.sensor import SensorConfig, brightest, expose
from scenes.shots import Placed, Shot
from scenes.stage import Stage

Image = NDArray[np.uint8]
AnyRanges = TypeVar("AnyRanges", LookRanges, SensorRanges, ViewRanges)
COLUMNS, TILE = 6, 120
"""Tiles a row; pixels along a tile."""
SEED = 5
NEIGHBOUR_M = (0.0095, 0.003)
"""Where the second part lies."""
ENVIRONMENT_LEVEL = 0.6
"""Light from all around where it is the only light."""
SHOWN_LENS = 0.1
"""Radial distortion that is shown, either way, where a data set has none."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Tiles (TILE, TILE, 3) and what is written beside them, a line each."""

    caption: tuple[str, ...]
    tiles: list[Image]


@dataclass(frozen=True, kw_only=True)
class SheetRanges:
    """The ranges that a sheet shows, and how many textures, environments and worn tags the stage has.

    ``physical``: whether the domain draws metal, environments and soft shadows.
    """

    look: LookRanges
    view: ViewRanges
    sensor: SensorRanges
    lens: LensRanges
    textures: int
    environments: int
    worn: int
    physical: bool


class RowMaker:
    """Renders the rows of one sheet on a stage; the exposure is the same in all tiles in which it does not vary."""

    def __init__(self, stage: Stage, parts: Sequence[Part], ranges: SheetRanges) -> None:
        self._stage, self._parts, self._ranges = stage, parts, ranges
        self._look, self._sensor = middle(ranges.look), middle(ranges.sensor)
        steep = float(np.interp(0.75, (0, 1), ranges.look.lamp_elevation_deg))
        self._glossy = replace(self._look, lamps=(1, 1), lamp_elevation_deg=(steep, steep))
        self._height_m = middle(ranges.view).height_m[0]
        self._wide, self._close = self._shot(2, (0.004, 0.001)), self._shot(1, (0.0055, 0.0015))
        self._tag = self._shot(4, TagboardConfig().centre(TagboardConfig().ids[0]))
        ideal = self._render(self._wide, self._drawn(self._look))
        self._exposed = draw_sensor(self._sensor, brightest(ideal), self._rng())

    def rows(self) -> Iterator[Row]:
        """All rows, from light to lens."""
        yield from self._light()
        yield from self._materials()
        yield from self._board()
        yield from self._camera()
        yield from self._readout()
        yield self._distortion()

    def _light(self) -> Iterator[Row]:
        yield self._sweep("lamps", "lamps")
        yield self._sweep("lamp elevation, deg", "lamp_elevation_deg")
        yield self._sweep("lamp strength", "lamp_total")
        tinted = replace(self._look, lamp_tint=self._ranges.look.lamp_tint)
        yield self._draws(("lamp colour,", f"s.d. {tinted.lamp_tint:g}"), [(tinted, k) for k in range(COLUMNS)])
        yield self._sweep("light all round", "ambient")
        if self._ranges.physical:
            yield self._sweep("lamp radius, m", "lamp_radius_m")
            bare = replace(self._drawn(self._look), lamps=(), ambient=ENVIRONMENT_LEVEL)
            looks = [replace(bare, environment=k) for k in range(COLUMNS)]
            caption = ("environments alone:", "tent, soft boxes,", "strips, windows,", "lab, ring light")
            yield Row(caption=caption, tiles=[self._tile(self._wide, look) for look in looks])
        else:
            yield self._sweep("lamp highlights", "lamp_specular", self._glossy)

    def _materials(self) -> Iterator[Row]:
        metals = [part.metallic > 0.5 for part in self._parts[:2]]
        if any(metals):
            yield self._sweep("metal brightness", "metal_level")
        if not all(metals):
            yield self._sweep("plastic brightness", "plastic_level")
        if self._ranges.physical:
            yield self._sweep("roughness, x nominal", "roughness")
            yield self._sweep("plate roughness", "board_roughness", self._glossy)
        else:
            yield self._sweep("roughness, x nominal", "roughness", self._glossy)
            yield self._sweep("highlights, x nominal", "specular", self._glossy)
        own = self._ranges.look
        names = ("metal_level", "plastic_level", "colour_exponent", "roughness", "metal_tint", "plastic_tint")
        free = replace(self._look, gold_share=0.3, **{name: getattr(own, name) for name in names})
        caption = ("materials drawn,", f"gold {own.gold_share:.0%} (here 30 %)")
        yield self._draws(caption, [(free, k) for k in range(COLUMNS)], surfaces=True)

    def _board(self) -> Iterator[Row]:
        yield self._sweep("plate brightness", "board_level")
        plain, own = self._drawn(self._look), self._ranges.look
        textures = [round(k * (self._ranges.textures - 1) / (COLUMNS - 1)) for k in range(COLUMNS)]
        looks = [replace(plain, texture=k, texture_repeat=float(np.mean(own.texture_repeat))) for k in textures]
        yield Row(
            caption=("plate texture", f"{own.texture_share:.0%} of images"),
            tiles=[self._tile(self._shot(4, (0.004, 0.001)), look) for look in looks],
        )
        repeats = [replace(looks[1], texture_repeat=repeat) for repeat in ends(own.texture_repeat)]
        yield Row(
            caption=_caption("texture repeats", own.texture_repeat),
            tiles=[self._tile(self._shot(4, (0.004, 0.001)), look) for look in repeats],
        )
        worn = [replace(plain, worn=k % (self._ranges.worn + 1) - 1) for k in range(COLUMNS)]
        levels = [replace(look, tag_level=level) for look, level in zip(worn, ends(own.tag_level), strict=True)]
        yield Row(
            caption=("tags: clean, worn;", *_caption("brightness", own.tag_level)),
            tiles=[self._tile(self._tag, look) for look in levels],
        )

    def _camera(self) -> Iterator[Row]:
        view, look = self._ranges.view, self._drawn(self._look)

        def seen(caption: tuple[str, ...], cameras: list[Array]) -> Row:
            return Row(caption=caption, tiles=[self._tile(_aimed(self._wide, T), look) for T in cameras])

        yield seen(_caption("camera height, m", view.height_m), [camera_above(h) for h in ends(view.height_m)])
        yaw = np.radians(ends((-view.yaw_deg, view.yaw_deg)))
        yield seen((f"camera turn +-{view.yaw_deg:g} deg",), [camera_above(self._height_m, float(a)) for a in yaw])
        tilt = np.radians(ends((-view.tilt_deg, view.tilt_deg)))
        yield seen((f"camera tilt +-{view.tilt_deg:g} deg",), [camera_above(self._height_m, tilt=(a, a)) for a in tilt])

    def _readout(self) -> Iterator[Row]:
        ideal = self._render(self._close, self._drawn(self._look))
        own = self._ranges.sensor

        def read(caption: tuple[str, ...], settings: list[SensorConfig], ideal: NDArray[Any] = ideal) -> Row:
            return Row(caption=caption, tiles=[expose(ideal, setting, self._rng()) for setting in settings])

        sharp = self._exposed
        focus = [replace(sharp, blur_px=sigma) for sigma in ends(own.blur_px)]
        yield read(_caption("focus, sigma px", own.blur_px), focus)
        level = brightest(ideal)
        highlights = [replace(self._sensor, highlight=(h, h)) for h in ends(own.highlight)]
        exposures = [draw_sensor(ranges, level, self._rng()) for ranges in highlights]
        yield read(_caption("exposure to level", own.highlight), exposures)
        slopes = [replace(sharp, gradient=(g, g)) for g in ends((-own.gradient, own.gradient))]
        yield read((f"uneven light +-{own.gradient:g}",), slopes)
        errors = ends((-own.white_balance, own.white_balance))
        gains = [((1 + e) / (1 - abs(e)), 1 / (1 - abs(e)), (1 - e) / (1 - abs(e))) for e in errors]
        caption = ("white balance:", f"red +-{own.white_balance:.0%},", "blue the other way")
        yield read(caption, [replace(sharp, white_balance=gain) for gain in gains])
        noise = [
            draw_sensor(replace(self._sensor, analog_gain_db=(g, g), dark_noise_e=(d, d)), level, self._rng())
            for g, d in zip(ends(own.analog_gain_db), ends(own.dark_noise_e), strict=True)
        ]
        gains_db, dark_e = own.analog_gain_db, own.dark_noise_e
        caption = (
            "noise: gain and dark",
            f"{gains_db[0]:g} .. {gains_db[1]:g} dB,",
            f"{dark_e[0]:g} .. {dark_e[1]:g} e-",
        )
        yield read(caption, [replace(sharp, shot_noise=n.shot_noise, read_noise=n.read_noise) for n in noise])
        gammas = ends(own.gamma if own.gamma[0] < own.gamma[1] else (0.5, 1.0))
        yield read((*_caption("gamma", own.gamma), "(shown 0.5 .. 1)"), [replace(sharp, gamma=g) for g in gammas])
        pairs = [replace(focus[k], bayer=bayer) for k in (0, 2, 4) for bayer in (False, True)]
        yield read(("without, with", "Bayer mosaic", f"({own.bayer_share:.0%} of images)"), pairs)
        image = expose(ideal, sharp, self._rng())
        qualities = (100, 95, 85, 70, 50, 30)
        yield Row(caption=("JPEG, where asked:", "100 .. 30"), tiles=[_jpeg(image, quality) for quality in qualities])

    def _distortion(self) -> Row:
        own, look = self._ranges.lens.k1, self._drawn(self._look)
        shown = own if own[0] < own[1] else (-SHOWN_LENS, SHOWN_LENS)
        caption = (*_caption("lens k1", own), f"(shown {shown[0]:g} .. {shown[1]:g},", "near the corner)")
        return Row(caption=caption, tiles=[self._tile(self._tag, look, Lens(k1=k1)) for k1 in ends(shown)])

    def _sweep(self, name: str, field: str, base: LookRanges | None = None) -> Row:
        """A range of the look from low to high, all else as in ``base``, at its middle where left out."""
        low_high = getattr(self._ranges.look, field)
        values = [round(v) if isinstance(low_high[0], int) else v for v in ends(low_high)]
        settings = [(replace(base or self._look, **{field: (value, value)}), 0) for value in values]
        return self._draws(_caption(name, low_high), settings)

    def _draws(
        self, caption: tuple[str, ...], settings: list[tuple[LookRanges, int]], *, surfaces: bool = False
    ) -> Row:
        """Looks drawn from ranges with a seed; the seed also draws the surfaces where asked."""
        tiles = []
        for ranges, seed in settings:
            look = self._drawn(self._look if surfaces else ranges, 0 if surfaces else seed)
            tiles.append(self._tile(self._wide, look, surfaces=ranges, seed=seed if surfaces else 0))
        return Row(caption=caption, tiles=tiles)

    def _drawn(self, ranges: LookRanges, seed: int = 0) -> Look:
        """A look from ranges: lamps from the same side whatever their strength, an environment, a plain plate."""
        return replace(draw_look(ranges, 0, self._rng(seed)), environment=0 if self._ranges.environments else -1)

    def _tile(
        self, shot: Shot, look: Look, lens: Lens = STRAIGHT, surfaces: LookRanges | None = None, seed: int = 0
    ) -> Image:
        return expose(self._render(shot, look, lens, surfaces, seed), self._exposed, self._rng(), shot.downscale)

    def _render(
        self, shot: Shot, look: Look, lens: Lens = STRAIGHT, surfaces: LookRanges | None = None, seed: int = 0
    ) -> NDArray[Any]:
        stage = self._stage
        stage.lens = lens
        stage.arrange(shot)
        stage.dress(shot, look, surfaces or self._look, self._rng(seed))
        drawn = stage.render(shot.intrinsics, ("rgb",)).rgb
        assert drawn is not None
        return drawn.copy()

    def _shot(self, downscale: int, focus: tuple[float, float]) -> Shot:
        """Two parts side by side at the board's centre, seen by the camera at its middle height round ``focus``."""
        first, second = self._parts[0], self._parts[1 % len(self._parts)]
        placed = [(first, planar(0.0, 0.0, 0.4)), (second, planar(*NEIGHBOUR_M, 2.3))]
        shot = Shot(
            intrinsics=BASLER.crop(0, 0, TILE * downscale, TILE * downscale).downscaled(downscale),
            downscale=downscale,
            T_board_cam=camera_above(self._height_m),
            focus_board=focus,
            parts=tuple(
                Placed(name=part.name, T_board_object=T @ part.stable_poses[0].T_table_part, stable_pose=0)
                for part, T in placed
            ),
            distractors=(),
        )
        return _aimed(shot, shot.T_board_cam)

    def _rng(self, seed: int = 0) -> np.random.Generator:
        return np.random.default_rng([SEED, seed])


def middle(ranges: AnyRanges) -> AnyRanges:
    """Ranges without extent: pairs at their middle, shares and deviations at zero, but shadows."""
    changes: dict[str, Any] = {}
    for item in fields(ranges):
        value = getattr(ranges, item.name)
        if isinstance(value, tuple):
            mean = (value[0] + value[1]) / 2
            changes[item.name] = (round(mean),) * 2 if isinstance(value[0], int) else (mean, mean)
        else:
            changes[item.name] = 0.0
    if isinstance(ranges, LookRanges):
        changes["shadow_share"] = 1.0
    return replace(ranges, **changes)


def ends(pair: tuple[float, float]) -> list[float]:
    """A row's values from the low to the high end."""
    return [float(v) for v in np.linspace(*pair, COLUMNS)]


def _aimed(shot: Shot, T_board_cam: Array) -> Shot:
    """The same shot from another camera, its window round the focus."""
    u, v = BASLER.project(apply(inverse(T_board_cam), [*shot.focus_board, 0.0]))
    side = int(TILE * shot.downscale)
    window = BASLER.crop(round(u) - side // 2, round(v) - side // 2, side, side)
    return replace(shot, intrinsics=window.downscaled(int(shot.downscale)), T_board_cam=T_board_cam)


def _jpeg(image: Image, quality: int) -> Image:
    ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert ok
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def _caption(name: str, pair: tuple[float, float]) -> tuple[str, ...]:
    return name, f"{pair[0]:g} .. {pair[1]:g}"
