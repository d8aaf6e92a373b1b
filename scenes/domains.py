"""The image domains: one scene, one camera, the same labels, drawn by different renderers."""

from __future__ import annotations

from typing import Literal, get_args

from scenes.classic import ClassicRenderer
from scenes.errors import SceneError
from scenes.gl import PROBLEM, mujoco
from scenes.render import Renderer

Domain = Literal["classic", "filament", "mitsuba"]
DOMAINS: tuple[Domain, ...] = get_args(Domain)


def domain_problem(domain: Domain) -> str:
    """What keeps this machine from rendering a domain and the command that mends it; empty when nothing does."""
    if domain == "classic":
        return PROBLEM
    if domain == "filament":
        from scenes.filament import filament_problem

        return filament_problem()
    from scenes.path_traced import mitsuba_problem

    return mitsuba_problem()


def make_renderer(domain: Domain, model: mujoco.MjModel, *, max_width: int, max_height: int) -> Renderer:
    """The renderer of a domain, for windows of up to that size.

    Raises SceneError when the domain is unknown or something it needs is missing.
    """
    if domain not in DOMAINS:
        raise SceneError(f"domain {domain!r} is not one of {', '.join(DOMAINS)}")
    problem = domain_problem(domain)
    if problem:
        raise SceneError(problem)
    if domain == "classic":
        return ClassicRenderer(model, max_width=max_width, max_height=max_height)
    if domain == "filament":
        from scenes.filament import FilamentRenderer

        return FilamentRenderer(model, max_width=max_width, max_height=max_height)
    from scenes.path_traced import MitsubaRenderer

    return MitsubaRenderer(model, max_width=max_width, max_height=max_height)
