"""What several tests of shots need: the built-in parts and how they come to rest."""

import pytest

from cad.parts import load_part, part_names
from scenes.rests import RestPool


@pytest.fixture(scope="session")
def parts():
    """The built-in parts by name."""
    return {name: load_part(name) for name in part_names()}


@pytest.fixture(scope="session")
def pool(parts):
    """Rests of the built-in parts."""
    return RestPool.make(list(parts.values()))
