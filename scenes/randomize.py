"""Draws what an image looks like from the ranges: lamps, surroundings, board, surfaces, camera, sensor and lens.

Every material is drawn once, for all domains: metallic and roughness for those that are physically based, and from
them the strength and the sharpness of highlights for the classic one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from cad.parts import Part
from cad.spatial import Array, rotation_from_rotvec, rotation_x, rotation_z, transform
from scenes.lens import Lens
from scenes.look import classic_finish
from scenes.ranges import LensRanges, LookRanges, Range, SensorRanges, ViewRanges
from scenes.sensor import SensorConfig, noise_levels

LIGHTS = 3
GOLD = (0.98, 0.87, 0.60)
"""Colour of gold plating, encoded as cameras deliver it."""
DARK_METAL = 0.4
"""A metal whose nominal colour is darker than this is blackened: never taken for one that is gold plated."""
ROUGHNESS: Range = (0.08, 0.95)
"""Limits of every roughness: smoother surfaces mirror single light sources as lines of fireflies."""
EXPOSURE: Range = (0.2, 4.0)
"""Limits of the factor by which exposure may change the levels that are rendered."""


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """One lamp in the board's frame.

    ``towards`` (3,) points from what the image shows to the lamp; ``rgb`` is its colour times its strength, where 1
    makes a white matt surface that faces it saturate. ``specular`` is the strength of its highlights (classic only),
    ``radius_m`` the radius of its bulb.
    """

    towards: tuple[float, float, float]
    rgb: tuple[float, float, float]
    specular: float
    shadow: bool
    distance_m: float = 0.5
    radius_m: float = 0.01


DEFAULT_LAMPS = (
    Lamp(towards=(0.359, 0.319, 0.877), rgb=(0.42, 0.42, 0.42), specular=0.5, shadow=True),
    Lamp(towards=(-0.405, -0.203, 0.891), rgb=(0.26, 0.26, 0.26), specular=0.3, shadow=False),
)
"""The pick cell's own two lamps."""
DEFAULT_AMBIENT = 0.32
DEFAULT_SURROUNDINGS = 0.52
"""Brightness of the table."""
DEFAULT_BOARD_ROUGHNESS = 0.8


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A material: colour, metalness and roughness, and the strength and sharpness of its highlight in classic."""

    rgb: tuple[float, float, float]
    metallic: float
    roughness: float
    specular: float
    shininess: float


@dataclass(frozen=True, kw_only=True)
class Look:
    """One draw of light and board.

    ``ambient`` is the light from all around as a share of what makes a white matt surface saturate; ``environment``
    the index of the environment that it comes from where environments are drawn, -1 for a plain one. ``texture`` is
    an index into the stage's textures, -1 for a plain plate; ``worn`` one into its worn tags, -1 for clean ones.
    """

    lamps: tuple[Lamp, ...]
    ambient: float
    environment: int = -1
    texture: int = -1
    texture_repeat: float = 1.0
    board_rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)
    board_roughness: float = DEFAULT_BOARD_ROUGHNESS
    worn: int = -1
    tag_level: float = 1.0
    surroundings_level: float = DEFAULT_SURROUNDINGS
    default: bool = False


DEFAULT_LOOK = Look(lamps=DEFAULT_LAMPS, ambient=DEFAULT_AMBIENT, default=True)
"""The pick cell's own look."""


def draw_look(
    ranges: LookRanges, textures: int, rng: np.random.Generator, *, environments: int = 0, worn: int = 0
) -> Look:
    """Draw lamps, surroundings and plate; the numbers are those of the stage's textures, environments, worn tags."""
    environment = int(rng.integers(environments)) if environments else -1
    if rng.random() < ranges.default_look:
        level = float(rng.uniform(0.9, 1.1))
        return replace(DEFAULT_LOOK, environment=environment, board_rgb=(level, level, level))
    textured = textures > 0 and rng.random() < ranges.texture_share
    level = rng.uniform(0.06, 0.35) if rng.random() < ranges.dark_board_share else rng.uniform(*ranges.board_level)
    worn_tags = worn > 0 and rng.random() < ranges.worn_share
    return Look(
        lamps=_draw_lamps(ranges, rng),
        ambient=float(rng.uniform(*ranges.ambient)),
        environment=environment,
        texture=int(rng.integers(textures)) if textured else -1,
        texture_repeat=float(rng.uniform(*ranges.texture_repeat)),
        board_rgb=_tinted(level, ranges.board_tint, rng),
        board_roughness=float(rng.uniform(*ranges.board_roughness)),
        worn=int(rng.integers(worn)) if worn_tags else -1,
        tag_level=float(rng.uniform(*ranges.tag_level)),
        surroundings_level=float(rng.uniform(*ranges.surroundings_level)),
    )


def _draw_lamps(ranges: LookRanges, rng: np.random.Generator) -> tuple[Lamp, ...]:
    count = int(rng.integers(ranges.lamps[0], ranges.lamps[1], endpoint=True))
    shares = rng.dirichlet(np.full(count, 2.0)) * rng.uniform(*ranges.lamp_total)
    lamps = []
    for i, share in enumerate(np.sort(shares)[::-1]):
        elevation, azimuth = np.radians(rng.uniform(*ranges.lamp_elevation_deg)), rng.uniform(0, 2 * np.pi)
        flat = np.cos(elevation)
        shadow = i == 0 and rng.random() < ranges.shadow_share
        lamps.append(
            Lamp(
                towards=(float(flat * np.cos(azimuth)), float(flat * np.sin(azimuth)), float(np.sin(elevation))),
                rgb=_tinted(share, ranges.lamp_tint, rng),
                specular=float(share * rng.uniform(*ranges.lamp_specular)),
                shadow=bool(shadow),
                distance_m=float(rng.uniform(*ranges.lamp_distance_m)),
                radius_m=float(rng.uniform(*ranges.lamp_radius_m)),
            )
        )
    return tuple(lamps)


def draw_part_surface(ranges: LookRanges, part: Part, default: bool, rng: np.random.Generator) -> Surface:
    """Draw a part's surface within the truth of its material; close to the nominal one in the default look.

    A metal stays a metal of its colour and a plastic one of its own; a small share of bright metals is gold plated.
    """
    rgb = np.array(part.rgba[:3])
    if default:
        return _surface(rgb * rng.uniform(0.85, 1.15), part.metallic, part.roughness)
    metal = part.metallic > 0.5
    if metal and rgb.max() > DARK_METAL and rng.random() < ranges.gold_share:
        rgb = np.array(GOLD)
    rgb = rgb ** rng.uniform(*ranges.colour_exponent)
    level = rng.uniform(*(ranges.metal_level if metal else ranges.plastic_level))
    tint = ranges.metal_tint if metal else ranges.plastic_tint
    return _surface(
        rgb * level * (1 + rng.normal(0, tint, 3)),
        rng.uniform(*ranges.metallic) if metal else 0.0,
        part.roughness * rng.uniform(*ranges.roughness),
        rng.uniform(*ranges.specular),
    )


def draw_distractor_surface(ranges: LookRanges, rng: np.random.Generator) -> Surface:
    """Draw a distractor's surface: metal, black or any colour."""
    kind, metallic = rng.random(), 0.0
    if kind < 0.5:
        level, metallic = rng.uniform(0.45, 0.95), rng.uniform(*ranges.metallic)
        rgb = level * (1 + rng.normal(0, ranges.metal_tint, 3))
    elif kind < 0.75:
        rgb = rng.uniform(0.02, 0.25) * (1 + rng.normal(0, ranges.plastic_tint, 3))
    else:
        rgb = rng.uniform(0.05, 0.95, 3)
    return _surface(rgb, metallic, rng.uniform(*ROUGHNESS), rng.uniform(*ranges.specular))


def _surface(rgb: Array, metallic: float, roughness: float, highlight: float = 1.0) -> Surface:
    """A surface whose classic finish follows from its physical one; ``highlight`` scales the strength of highlights.

    A colour that would reflect more than all light is darkened, so that it keeps its hue.
    """
    metallic, roughness = float(metallic), float(np.clip(roughness, *ROUGHNESS))
    specular, shininess = classic_finish(metallic, roughness)
    return Surface(
        rgb=_triple(np.maximum(rgb, 0.0) / max(float(rgb.max()), 1.0)),
        metallic=metallic,
        roughness=roughness,
        specular=float(min(specular * highlight, 1.0)),
        shininess=shininess,
    )


def draw_camera(ranges: ViewRanges, rng: np.random.Generator) -> Array:
    """Draw ``T_board_cam`` (4, 4): nominally straight above the board's centre, image right along the board's x."""
    shift = rng.uniform(-ranges.shift_m, ranges.shift_m, 2)
    height = rng.uniform(*ranges.height_m)
    yaw = np.radians(rng.uniform(-ranges.yaw_deg, ranges.yaw_deg))
    return camera_above(height, yaw, np.radians(rng.uniform(-ranges.tilt_deg, ranges.tilt_deg, 2)), shift)


def camera_above(
    height_m: float, yaw: float = 0.0, tilt: ArrayLike = (0.0, 0.0), shift_m: ArrayLike = (0.0, 0.0)
) -> Array:
    """``T_board_cam`` (4, 4) of a camera that looks down, turned and tilted (2,) by rad, shifted by (2,) m."""
    R = rotation_z(yaw) @ rotation_x(np.pi) @ rotation_from_rotvec([*np.asarray(tilt), 0.0])
    return transform(R, [*np.asarray(shift_m), height_m])


def draw_sensor(ranges: SensorRanges, brightest: float, rng: np.random.Generator) -> SensorConfig:
    """Draw a setting of the sensor whose exposure brings the ``brightest`` grey level of an image to the highlight.

    The smallest of the colour gains is 1, as in a camera, so that what saturates stays white.
    """
    red, blue = 1 + rng.uniform(-ranges.white_balance, ranges.white_balance, 2)
    smallest = min(red, 1.0, blue)
    highlight = rng.uniform(*ranges.highlight)
    shot_noise, read_noise = noise_levels(
        saturation_e=rng.uniform(*ranges.saturation_e),
        dark_noise_e=rng.uniform(*ranges.dark_noise_e),
        analog_gain_db=rng.uniform(*ranges.analog_gain_db),
    )
    return SensorConfig(
        exposure=float(np.clip(highlight / max(brightest, 1.0), *EXPOSURE)),
        gradient=_pair(rng.uniform(-ranges.gradient, ranges.gradient, 2)),
        blur_px=float(rng.uniform(*ranges.blur_px)),
        shot_noise=shot_noise,
        read_noise=read_noise,
        white_balance=_triple(np.array([red, 1.0, blue]) / smallest),
        bayer=bool(rng.random() < ranges.bayer_share),
        gamma=float(rng.uniform(*ranges.gamma)),
        quick=True,
    )


def draw_lens(ranges: LensRanges, rng: np.random.Generator) -> Lens:
    """Draw the distortion of the lens."""
    return Lens(**{name: float(rng.uniform(*getattr(ranges, name))) for name in ("k1", "k2", "p1", "p2")})


def _tinted(level: float, tint: float, rng: np.random.Generator) -> tuple[float, float, float]:
    return _triple(np.clip(level * (1 + rng.normal(0, tint, 3)), 0.0, 1.3))


def _triple(rgb: Array) -> tuple[float, float, float]:
    return float(rgb[0]), float(rgb[1]), float(rgb[2])


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])
