from pathlib import Path

import numpy as np
import pytest
from build123d import import_step

from cad.models.samples import SAMPLES, main

PARTS = Path(__file__).parents[2] / "examples" / "parts"


@pytest.mark.parametrize(
    ("name", "solids", "low", "high"),
    [
        ("m2_screw", 1, (-1.9, -1.9, -6.0), (1.9, 1.9, 2.0)),
        ("hex_nut", 1, (-4 / np.sqrt(3), -2.0, -0.8), (4 / np.sqrt(3), 2.0, 0.8)),
        ("pin_header", 5, (-5.08, -1.27, -3.0), (5.08, 1.27, 8.54)),
        ("bracket", 1, (0.0, 0.0, 0.0), (8.0, 6.0, 5.0)),
    ],
)
def test_a_sample_has_its_standard_size_and_ships_as_it_is_made(name, solids, low, high):
    shape = SAMPLES[name]()
    box = shape.bounding_box()
    np.testing.assert_allclose(tuple(box.min), low, atol=1e-4)
    np.testing.assert_allclose(tuple(box.max), high, atol=1e-4)
    assert len(shape.solids()) == solids and shape.is_valid
    shipped = import_step(PARTS / f"{name}.step")
    assert shipped.volume == pytest.approx(shape.volume, rel=1e-6)


def test_the_files_come_out_the_same_every_time(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["samples", str(tmp_path)])
    main()
    for name in SAMPLES:
        assert (tmp_path / f"{name}.step").read_bytes() == (PARTS / f"{name}.step").read_bytes()


def test_the_solids_of_the_header_touch_without_overlapping():
    body, *pins = SAMPLES["pin_header"]().solids()
    for pin in pins:
        common = body & pin
        assert common is None or sum(solid.volume for solid in common.solids()) < 1e-9
        assert body.distance_to(pin) == pytest.approx(0, abs=1e-9)
