"""What varies between training images, as ranges, and the draw of one look from them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cad.spatial import Array, rotation_from_rotvec, rotation_x, rotation_z, transform
from scenes.errors import SceneError
from scenes.sensor import SensorConfig

Range = tuple[float, float]
LIGHTS = 3


@dataclass(frozen=True, kw_only=True)
class LookRanges:
    """Uniform ranges (low, high) of everything that changes how a scene looks; angles in degrees.

    A share ``default_look`` of the images keeps the pick cell's own look: plain light plate, its two lamps.
    """

    default_look: float = 0.3
    light_elevation_deg: Range = (35.0, 88.0)
    light_total: Range = (0.45, 0.95)
    light_tint: float = 0.06
    light_specular: Range = (0.2, 1.2)
    shadow_share: float = 0.8
    ambient: Range = (0.12, 0.45)
    metal_level: Range = (0.45, 0.98)
    metal_tint: float = 0.04
    gold_share: float = 0.15
    plastic_level: Range = (0.015, 0.20)
    specular: Range = (0.0, 0.9)
    shininess: Range = (0.05, 0.95)
    texture_share: float = 0.65
    texture_repeat: Range = (2.0, 9.0)
    board_level: Range = (0.35, 1.25)
    dark_board_share: float = 0.12
    board_tint: float = 0.06
    tag_level: Range = (0.7, 1.1)
    surroundings_level: Range = (0.1, 0.8)
    highlight: Range = (110.0, 252.0)
    blur_px: Range = (0.4, 1.8)
    shot_noise: Range = (0.005, 0.08)
    read_noise: Range = (0.3, 3.0)
    gradient: float = 0.10

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, tuple) and value[0] > value[1]:
                raise SceneError(f"range {name} = {value}: the low end must not exceed the high end")


@dataclass(frozen=True, kw_only=True)
class ViewRanges:
    """How far the camera may be from its nominal place: metres and degrees, each way."""

    height_m: float = 0.70
    height_range_m: float = 0.010
    tilt_deg: float = 1.0
    yaw_deg: float = 15.0
    shift_m: float = 0.010


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """One directional light in the board's frame: unit vector towards it, colour and strength of its highlight."""

    towards: tuple[float, float, float]
    rgb: tuple[float, float, float]
    specular: float
    shadow: bool


DEFAULT_LAMPS = (
    Lamp(towards=(0.359, 0.319, 0.877), rgb=(0.42, 0.42, 0.42), specular=0.5, shadow=True),
    Lamp(towards=(-0.405, -0.203, 0.891), rgb=(0.26, 0.26, 0.26), specular=0.3, shadow=False),
)
"""The pick cell's own two lamps."""
DEFAULT_AMBIENT = 0.32
DEFAULT_SURROUNDINGS = 0.52
"""Brightness of the table."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A material: colour, strength and sharpness of its highlight."""

    rgb: tuple[float, float, float]
    specular: float
    shininess: float


@dataclass(frozen=True, kw_only=True)
class Look:
    """One draw: lamps, ambient light, the plate, the brightness of the tags and of the table round the plate.

    ``texture`` is an index into the stage's textures, -1 for a plain plate.
    """

    lamps: tuple[Lamp, ...]
    ambient: float
    texture: int
    texture_repeat: float
    board_rgb: tuple[float, float, float]
    tag_level: float
    surroundings_level: float
    default: bool = field(default=False)


def draw_look(ranges: LookRanges, textures: int, rng: np.random.Generator) -> Look:
    """Draw lamps and plate; ``textures`` is the number of textures there are."""
    if rng.random() < ranges.default_look:
        level = float(rng.uniform(0.9, 1.1))
        return Look(
            lamps=DEFAULT_LAMPS,
            ambient=DEFAULT_AMBIENT,
            texture=-1,
            texture_repeat=1.0,
            board_rgb=(level, level, level),
            tag_level=1.0,
            surroundings_level=DEFAULT_SURROUNDINGS,
            default=True,
        )
    textured = rng.random() < ranges.texture_share
    level = rng.uniform(0.06, 0.35) if rng.random() < ranges.dark_board_share else rng.uniform(*ranges.board_level)
    return Look(
        lamps=_draw_lamps(ranges, rng),
        ambient=float(rng.uniform(*ranges.ambient)),
        texture=int(rng.integers(textures)) if textured else -1,
        texture_repeat=float(rng.uniform(*ranges.texture_repeat)),
        board_rgb=_tinted(level, ranges.board_tint, rng),
        tag_level=float(rng.uniform(*ranges.tag_level)),
        surroundings_level=float(rng.uniform(*ranges.surroundings_level)),
    )


def _draw_lamps(ranges: LookRanges, rng: np.random.Generator) -> tuple[Lamp, ...]:
    count = int(rng.integers(1, LIGHTS + 1))
    shares = rng.dirichlet(np.full(count, 2.0)) * rng.uniform(*ranges.light_total)
    lamps = []
    for i, share in enumerate(np.sort(shares)[::-1]):
        elevation, azimuth = np.radians(rng.uniform(*ranges.light_elevation_deg)), rng.uniform(0, 2 * np.pi)
        flat = np.cos(elevation)
        towards = (float(flat * np.cos(azimuth)), float(flat * np.sin(azimuth)), float(np.sin(elevation)))
        shadow = i == 0 and rng.random() < ranges.shadow_share
        rgb = _tinted(share, ranges.light_tint, rng)
        specular = float(share * rng.uniform(*ranges.light_specular))
        lamps.append(Lamp(towards=towards, rgb=rgb, specular=specular, shadow=bool(shadow)))
    return tuple(lamps)


def draw_part_surface(
    ranges: LookRanges, nominal: Surface, metallic: bool, default: bool, rng: np.random.Generator
) -> Surface:
    """Draw a part's surface within what its material may look like; near its nominal colour in the default look."""
    if default:
        level = rng.uniform(0.85, 1.15)
        rgb = np.clip(np.array(nominal.rgb) * level, 0, 1)
        return Surface(rgb=_triple(rgb), specular=nominal.specular, shininess=nominal.shininess)
    if not metallic:
        rgb = _tinted(rng.uniform(*ranges.plastic_level), 0.1, rng)
    elif rng.random() < ranges.gold_share:
        rgb = _triple(np.array([0.95, 0.78, 0.42]) * rng.uniform(0.7, 1.05))
    else:
        rgb = _tinted(rng.uniform(*ranges.metal_level), ranges.metal_tint, rng)
    specular, shininess = float(rng.uniform(*ranges.specular)), float(rng.uniform(*ranges.shininess))
    return Surface(rgb=rgb, specular=specular, shininess=shininess)


def draw_distractor_surface(ranges: LookRanges, rng: np.random.Generator) -> Surface:
    """Draw a distractor's surface: metal, black or any colour."""
    kind = rng.random()
    if kind < 0.5:
        rgb = _tinted(rng.uniform(*ranges.metal_level), ranges.metal_tint, rng)
    elif kind < 0.75:
        rgb = _tinted(rng.uniform(0.02, 0.25), 0.1, rng)
    else:
        rgb = _triple(rng.uniform(0.05, 0.95, 3))
    specular, shininess = float(rng.uniform(*ranges.specular)), float(rng.uniform(*ranges.shininess))
    return Surface(rgb=rgb, specular=specular, shininess=shininess)


def draw_camera(ranges: ViewRanges, rng: np.random.Generator) -> Array:
    """Draw ``T_board_cam`` (4, 4): nominally straight above the board's centre, image right along the board's x."""
    shift = rng.uniform(-ranges.shift_m, ranges.shift_m, 2)
    height = ranges.height_m + rng.uniform(-ranges.height_range_m, ranges.height_range_m)
    yaw = np.radians(rng.uniform(-ranges.yaw_deg, ranges.yaw_deg))
    tilt = np.radians(rng.uniform(-ranges.tilt_deg, ranges.tilt_deg, 2))
    R = rotation_z(yaw) @ rotation_x(np.pi) @ rotation_from_rotvec([tilt[0], tilt[1], 0.0])
    return transform(R, [*shift, height])


def draw_sensor(ranges: LookRanges, brightest: float, rng: np.random.Generator) -> SensorConfig:
    """Draw a sensor setting whose exposure brings the ``brightest`` grey level of an image into the highlight range."""
    gain = np.clip(rng.uniform(*ranges.highlight) / max(brightest, 1.0), 0.5, 3.0)
    return SensorConfig(
        gain=float(gain),
        gradient=(
            float(rng.uniform(-ranges.gradient, ranges.gradient)),
            float(rng.uniform(-ranges.gradient, ranges.gradient)),
        ),
        blur_px=float(rng.uniform(*ranges.blur_px)),
        shot_noise=float(rng.uniform(*ranges.shot_noise)),
        read_noise=float(rng.uniform(*ranges.read_noise)),
    )


def _tinted(level: float, tint: float, rng: np.random.Generator) -> tuple[float, float, float]:
    return _triple(np.clip(level * (1 + rng.normal(0, tint, 3)), 0.0, 1.3))


def _triple(rgb: Array) -> tuple[float, float, float]:
    return float(rgb[0]), float(rgb[1]), float(rgb[2])
