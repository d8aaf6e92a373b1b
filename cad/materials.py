"""What common materials of small parts weigh and look like.

Densities are handbook values at room temperature (typical of the named grade). Colours are sRGB-encoded, as cameras
deliver them; ``metallic`` and ``roughness`` are those of the metallic-roughness model that the renderers share.
"""

from __future__ import annotations

from dataclasses import dataclass

from cad.parts import CadError


class MaterialError(CadError):
    """A material that is not in the table."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """One material: ``grade`` for people, density in kg/m3, colour and finish in 0 to 1."""

    grade: str
    density_kg_m3: float
    rgb: tuple[float, float, float]
    metallic: float
    roughness: float

    def __str__(self) -> str:
        return f"{self.grade}, {1e-3 * self.density_kg_m3:.2f} g/cm3"


MATERIALS = {
    "steel": Material(
        grade="stainless steel", density_kg_m3=7900.0, rgb=(0.74, 0.74, 0.76), metallic=1.0, roughness=0.3
    ),
    "black-steel": Material(
        grade="blackened steel", density_kg_m3=7850.0, rgb=(0.22, 0.22, 0.23), metallic=1.0, roughness=0.5
    ),
    "brass": Material(grade="brass", density_kg_m3=8500.0, rgb=(0.82, 0.70, 0.42), metallic=1.0, roughness=0.3),
    "copper": Material(grade="copper", density_kg_m3=8960.0, rgb=(0.85, 0.57, 0.45), metallic=1.0, roughness=0.3),
    "aluminium": Material(
        grade="aluminium", density_kg_m3=2700.0, rgb=(0.80, 0.81, 0.82), metallic=1.0, roughness=0.35
    ),
    "zinc": Material(
        grade="zinc die casting", density_kg_m3=6700.0, rgb=(0.66, 0.67, 0.69), metallic=1.0, roughness=0.4
    ),
    "nylon": Material(grade="nylon 66", density_kg_m3=1140.0, rgb=(0.90, 0.89, 0.84), metallic=0.0, roughness=0.5),
    "abs": Material(grade="ABS", density_kg_m3=1050.0, rgb=(0.30, 0.30, 0.31), metallic=0.0, roughness=0.45),
    "pom": Material(grade="POM", density_kg_m3=1410.0, rgb=(0.93, 0.93, 0.92), metallic=0.0, roughness=0.4),
    "lcp": Material(
        grade="liquid crystal polymer, glass filled",
        density_kg_m3=1600.0,
        rgb=(0.2, 0.2, 0.21),
        metallic=0.0,
        roughness=0.55,
    ),
    "ptfe": Material(grade="PTFE", density_kg_m3=2200.0, rgb=(0.94, 0.94, 0.94), metallic=0.0, roughness=0.5),
    "rubber": Material(grade="rubber", density_kg_m3=1200.0, rgb=(0.12, 0.12, 0.12), metallic=0.0, roughness=0.8),
    "ceramic": Material(grade="alumina", density_kg_m3=3900.0, rgb=(0.93, 0.92, 0.89), metallic=0.0, roughness=0.5),
}


def material(name: str) -> Material:
    """The material called ``name``; raises MaterialError naming those there are."""
    if name not in MATERIALS:
        raise MaterialError(
            f"no material is called {name!r}; there are {', '.join(MATERIALS)}: choose the nearest and give the part's "
            "own --density or --mass-g"
        )
    return MATERIALS[name]
