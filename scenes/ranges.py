"""What varies between images, as ranges: light, materials, board, camera, sensor and lens. Each has its unit.

A pair is (low, high) of a uniform distribution. ``TRAIN_*`` are the ranges of the splits ``train`` and ``val``,
``TEST_*`` those of ``test``, whose light, background and distance the others never show.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, get_type_hints

import numpy as np

from scenes.errors import SceneError

Range = tuple[float, float]
Split = Literal["train", "val", "test"]


class Within(NamedTuple):
    """The limits that a value, or both ends of a range, must keep."""

    low: float
    high: float


class _Ranges:
    """Base of the range dataclasses: checks every field against its limits."""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            value, limits = getattr(self, name), hint.__metadata__[0]
            ends = value if isinstance(value, tuple) else (value,)
            if not all(np.isfinite(end) and limits.low <= end <= limits.high for end in ends):
                raise SceneError(f"range {name} = {value}: must stay within {limits.low:g} to {limits.high:g}")
            if ends[0] > ends[-1]:
                raise SceneError(f"range {name} = {value}: the low end must not exceed the high end")


@dataclass(frozen=True, kw_only=True)
class LookRanges(_Ranges):
    """Light, materials and board. Strengths and levels are shares of what makes a white matt surface just saturate."""

    default_look: Annotated[float, Within(0, 1)] = 0.3
    """Share of images with the pick cell's own look: its two lamps, clean tags on a plain light plate."""
    lamps: Annotated[tuple[int, int], Within(1, 3)] = (1, 3)
    """Number of lamps, both ends included."""
    lamp_elevation_deg: Annotated[Range, Within(5, 90)] = (35.0, 88.0)
    """Elevation of a lamp over the board, degrees; any azimuth."""
    lamp_distance_m: Annotated[Range, Within(0.1, 10)] = (0.35, 1.2)
    """Distance of a lamp from what the image shows, metres."""
    lamp_radius_m: Annotated[Range, Within(0.0, 0.5)] = (0.004, 0.06)
    """Radius of a lamp's bulb, metres: with its distance it decides how soft shadows are where a domain draws that."""
    lamp_total: Annotated[Range, Within(0, 4)] = (0.45, 0.95)
    """Strength of all lamps together."""
    lamp_tint: Annotated[float, Within(0, 0.5)] = 0.06
    """Standard deviation of each colour channel of a lamp, relative."""
    lamp_specular: Annotated[Range, Within(0, 2)] = (0.2, 1.2)
    """Strength of a lamp's highlights relative to its light (classic only)."""
    shadow_share: Annotated[float, Within(0, 1)] = 0.8
    """Share of images whose strongest lamp casts shadows."""
    ambient: Annotated[Range, Within(0, 2)] = (0.12, 0.45)
    """Light from all around: a constant in classic, the level of the environment elsewhere."""
    metal_level: Annotated[Range, Within(0.1, 2)] = (0.8, 1.3)
    """Brightness of a metal relative to its nominal colour."""
    plastic_level: Annotated[Range, Within(0.1, 2)] = (0.5, 1.3)
    """Brightness of a plastic relative to its nominal colour."""
    colour_exponent: Annotated[Range, Within(0.5, 3)] = (1.0, 2.2)
    """Power of the nominal colour: 1 takes the tabled, encoded value as the reflectance, 2.2 decodes it."""
    metal_tint: Annotated[float, Within(0, 0.2)] = 0.03
    """Standard deviation of each colour channel of a metal, relative."""
    plastic_tint: Annotated[float, Within(0, 0.3)] = 0.05
    """Standard deviation of each colour channel of a plastic, relative."""
    gold_share: Annotated[float, Within(0, 1)] = 0.1
    """Share of bright metal parts that are gold plated."""
    metallic: Annotated[Range, Within(0.5, 1)] = (0.9, 1.0)
    """Metalness of a metal; that of a plastic is 0."""
    roughness: Annotated[Range, Within(0.1, 4)] = (0.5, 1.7)
    """Roughness relative to the material's nominal one; the result stays within 0.08 to 0.95."""
    specular: Annotated[Range, Within(0, 3)] = (0.2, 1.6)
    """Strength of highlights relative to the material's nominal one."""
    texture_share: Annotated[float, Within(0, 1)] = 0.65
    """Share of images with a textured plate."""
    texture_repeat: Annotated[Range, Within(0.1, 50)] = (1.0, 9.0)
    """How often a texture repeats over the plate's width."""
    board_level: Annotated[Range, Within(0, 2)] = (0.35, 1.25)
    """Brightness of the plate, relative to its texture."""
    dark_board_share: Annotated[float, Within(0, 1)] = 0.12
    """Share of images with a dark plate, of level 0.06 to 0.35."""
    board_tint: Annotated[float, Within(0, 0.5)] = 0.06
    """Standard deviation of each colour channel of the plate, relative."""
    board_roughness: Annotated[Range, Within(0.08, 1)] = (0.3, 0.95)
    """Roughness of the plate."""
    worn_share: Annotated[float, Within(0, 1)] = 0.5
    """Share of images with worn tags: faded, scratched, stained."""
    tag_level: Annotated[Range, Within(0.2, 2)] = (0.7, 1.1)
    """Brightness of the tags' paper."""
    surroundings_level: Annotated[Range, Within(0, 2)] = (0.1, 0.8)
    """Brightness of the table round the plate."""


@dataclass(frozen=True, kw_only=True)
class ViewRanges(_Ranges):
    """Where the camera is: nominally straight above the board's centre."""

    height_m: Annotated[Range, Within(0.2, 3)] = (0.69, 0.71)
    """Height of the camera over the board, metres."""
    tilt_deg: Annotated[float, Within(0, 30)] = 1.0
    """Largest tilt about each of the image's axes, degrees, either way."""
    yaw_deg: Annotated[float, Within(0, 180)] = 15.0
    """Largest turn about the optical axis, degrees, either way."""
    shift_m: Annotated[float, Within(0, 0.3)] = 0.010
    """Largest shift along each of the board's axes, metres, either way."""


@dataclass(frozen=True, kw_only=True)
class SensorRanges(_Ranges):
    """Focus, exposure, colour balance and the noise of the sensor, in the terms of EMVA 1288.

    The camera's IMX183 saturates at 15,000 electrons (12 bits of 3.66 electrons: ZWO's ASI183, quoted in AAVSO's forum)
    or 16,100 (42.08 dB signal to noise at saturation: Daheng's MER2-2000-19U3M, va-imaging.com). Its quantum efficiency
    is part of the exposure: noise depends on the electrons that are there.
    """

    highlight: Annotated[Range, Within(20, 1000)] = (110.0, 252.0)
    """Exposure: the grey level that the brightest fiftieth of the image reaches, levels of 255."""
    blur_px: Annotated[Range, Within(0, 20)] = (0.4, 1.8)
    """Focus: sigma of the optical blur, pixels of the full-resolution frame."""
    gradient: Annotated[float, Within(0, 0.9)] = 0.10
    """Largest relative change of brightness from the image's middle to its border, either way."""
    white_balance: Annotated[float, Within(0, 0.9)] = 0.08
    """Largest relative error of the red and of the blue gain, either way."""
    analog_gain_db: Annotated[Range, Within(0, 24)] = (0.0, 12.0)
    """Gain before the converter, dB: 6 dB halve the electrons that saturate a pixel."""
    saturation_e: Annotated[Range, Within(100, 1e6)] = (14500.0, 16100.0)
    """Saturation capacity at 0 dB, electrons."""
    dark_noise_e: Annotated[Range, Within(0, 1000)] = (2.5, 30.0)
    """Temporal dark noise, electrons: a few of a cool sensor, and more for warm ones and flickering light."""
    bayer_share: Annotated[float, Within(0, 1)] = 0.3
    """Share of images read through a Bayer mosaic; the others are those of an ideal three-chip camera."""
    gamma: Annotated[Range, Within(0.2, 4)] = (1.0, 1.0)
    """The camera's Gamma: output = 255 (level / 255) ** gamma."""


@dataclass(frozen=True, kw_only=True)
class LensRanges(_Ranges):
    """Distortion after Brown and Conrady in OpenCV's terms, of normalised image coordinates; none by default.

    The frame's corner is 0.316 from the axis: k1 = 0.01 moves it by 0.1 %, 3.3 pixels of the full-resolution frame.
    """

    k1: Annotated[Range, Within(-1, 1)] = (0.0, 0.0)
    """Radial, second order; negative for a barrel."""
    k2: Annotated[Range, Within(-5, 5)] = (0.0, 0.0)
    """Radial, fourth order."""
    p1: Annotated[Range, Within(-0.05, 0.05)] = (0.0, 0.0)
    """Tangential, along v."""
    p2: Annotated[Range, Within(-0.05, 0.05)] = (0.0, 0.0)
    """Tangential, along u."""


TRAIN_LOOK = LookRanges()
TEST_LOOK = LookRanges(
    default_look=0.0,
    lamps=(1, 2),
    lamp_elevation_deg=(25.0, 34.0),
    lamp_total=(0.55, 1.0),
    lamp_tint=0.08,
    ambient=(0.07, 0.115),
    texture_share=0.9,
    texture_repeat=(10.0, 14.0),
    board_tint=0.08,
    surroundings_level=(0.02, 0.09),
)
"""Flatter, more coloured light over less of it from around; finer, more coloured backgrounds."""
TRAIN_VIEW = ViewRanges()
TEST_VIEW = ViewRanges(height_m=(0.725, 0.745))
"""Further away: parts are 3 to 7 % smaller in the image."""

LOOKS: dict[Split, LookRanges] = {"train": TRAIN_LOOK, "val": TRAIN_LOOK, "test": TEST_LOOK}
VIEWS: dict[Split, ViewRanges] = {"train": TRAIN_VIEW, "val": TRAIN_VIEW, "test": TEST_VIEW}
