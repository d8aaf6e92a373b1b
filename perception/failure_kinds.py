"""What kind of failure an outcome is, and which failures are worth looking at first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from perception.outcomes import Outcome

WRONG_CLASS, WRONG_FACE, FLIP, TURNED = "wrong class", "wrong face", "flip", "turned"
FALSE, MISSED = "false detection", "missed"
KINDS = (WRONG_CLASS, WRONG_FACE, FLIP, TURNED, FALSE, MISSED)


def failure_kind(outcome: Outcome) -> str | None:
    """One of ``KINDS``, None for what is no failure: parts on the right branch, and those that are not whole.

    A flip is the right face more than 90 degrees off, what is turned by less is "turned". A detection of no part counts
    when it was accepted.
    """
    if not outcome.whole:
        return None
    if not outcome.is_part:
        return FALSE if outcome.accepted else None
    if not outcome.detected:
        return MISSED
    if outcome.branch_right_equivalent:
        return None
    if not outcome.class_right:
        return WRONG_CLASS
    if not outcome.face_right:
        return WRONG_FACE
    return FLIP if outcome.flipped else TURNED


def worst_failures(outcomes: Iterable[Outcome], most: int) -> list[tuple[str, Outcome]]:
    """At most ``most`` failures with their kinds, as many of each as there are places, ordered by kind.

    Within a kind the accepted ones come first, then those with the higher score, or of which more is visible.
    """
    found = [(kind, o) for o in outcomes if (kind := failure_kind(o)) is not None]
    found.sort(key=lambda f: (not f[1].accepted, -f[1].score, -f[1].visible_share))
    rank: Counter[str] = Counter()
    ranked = []
    for kind, outcome in found:
        ranked.append((rank[kind], kind, outcome))
        rank[kind] += 1
    kept = sorted(ranked, key=lambda r: (r[0], KINDS.index(r[1])))[:most]
    return [(kind, outcome) for _, kind, outcome in sorted(kept, key=lambda r: (KINDS.index(r[1]), r[0]))]
