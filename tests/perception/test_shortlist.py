from dataclasses import replace

import numpy as np
import pytest

from perception.faces import FaceTable
from perception.posenets import CropReading, Hypothesis
from perception.shortlist import ShortlistConfig, shortlist
from perception.sighting import Sighting
from tests.perception.conftest import box, make_part

CONFIG = ShortlistConfig()


def part(name: str):
    made = make_part(box((8, 6, 2)), (np.eye(3), np.diag([1.0, -1.0, -1.0])), name=name)
    return replace(made, stable_poses=tuple(replace(p, view_equivalents=()) for p in made.stable_poses))


TABLE = FaceTable([part("a"), part("b")])


def guess(name: str, face: int, yaw: float, classifier: float, verifier: float) -> Hypothesis:
    return Hypothesis(
        part=name, stable_pose=face, yaw=yaw, centre_px=(60.0, 60.0), classifier=classifier, verifier=verifier
    )


BEST = guess("a", 0, 0.3, -0.1, -0.1)
OTHERS = (guess("a", 1, 0.3, -6.0, -7.0), guess("b", 0, 1.0, -7.0, -8.0), guess("b", 1, 2.0, -7.5, -8.0))


def reading(*hypotheses: Hypothesis, not_a_part: float = 0.01, b: float = 0.02) -> CropReading:
    return CropReading(hypotheses=hypotheses, not_a_part=not_a_part, class_probabilities={"a": 1 - b, "b": b})


def seen_as(name: str) -> Sighting:
    p = {"a": 0.1, "b": 0.1} | {name: 0.9}
    return Sighting(score=0.9, class_probabilities=p, mask=np.ones((128, 128), bool), cut=False)


def test_one_is_refined_when_all_agree() -> None:
    found = shortlist(reading(BEST, *OTHERS), seen_as("a"), TABLE, CONFIG)
    assert found.sure
    assert found.wanted == (BEST,)
    thorough = shortlist(reading(BEST, *OTHERS), seen_as("a"), TABLE, replace(CONFIG, thorough=True))
    assert thorough.sure
    assert thorough.wanted == found.others


def test_what_the_contour_does_not_bear_out_is_tested_turned_round_and_as_another_class() -> None:
    others = shortlist(reading(BEST, *OTHERS), seen_as("a"), TABLE, CONFIG).others
    assert OTHERS[1] in others
    (turned,) = [h for h in others if (h.part, h.stable_pose) == ("a", 0) and h is not BEST]
    assert abs(np.angle(np.exp(1j * (turned.yaw - BEST.yaw)))) == pytest.approx(np.pi)
    assert turned.log_probability < min(h.log_probability for h in (BEST, *OTHERS))


@pytest.mark.parametrize(
    ("found", "sighting"),
    [
        (reading(BEST, *OTHERS), seen_as("b")),
        (reading(BEST, guess("a", 1, 0.3, -2.0, -0.05), *OTHERS), seen_as("a")),
        (reading(BEST, guess("a", 1, 0.3, -0.05, -2.0), *OTHERS), seen_as("a")),
        (reading(BEST, guess("a", 0, 0.3 + np.pi, -2.0, -2.0), *OTHERS), seen_as("a")),
    ],
    ids=["segmenter", "verifier", "classifier", "lead"],
)
def test_whoever_disagrees_is_heard(found: CropReading, sighting: Sighting) -> None:
    short = shortlist(found, sighting, TABLE, CONFIG)
    assert not short.sure
    assert 2 < len(short.wanted) <= CONFIG.most
    assert any(h.part == "b" for h in short.wanted)


def test_the_opposite_yaw_is_not_tested_where_it_looks_the_same() -> None:
    found = shortlist(reading(BEST, guess("a", 0, 0.3 + np.pi, -1.0, -1.0), b=0.001), seen_as("a"), TABLE, CONFIG)
    assert len(found.others) == 2
    assert len({h.yaw for h in found.others}) == 2


def test_nothing_is_refined_where_both_networks_see_nothing() -> None:
    found = shortlist(reading(BEST, *OTHERS, not_a_part=0.97), seen_as("a"), TABLE, CONFIG)
    assert found.wanted == ()
    assert not found.sure


def test_settings_that_make_no_sense_are_errors() -> None:
    with pytest.raises(ValueError, match="refined"):
        ShortlistConfig(refined=0)
    with pytest.raises(ValueError, match="sure_nats"):
        ShortlistConfig(sure_nats=0.0)
