"""Another look at what the estimator is unsure of: which one to take next, and what all looks at a part say together.

Nothing here moves or exposes: the policy is told what each look showed, and answers with the next one, cheapest first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cad.spatial import Array
from twin.candidates import Candidate
from twin.evidence import agreement
from twin.nudge import Nudge, NudgeConfig
from twin.views import USUAL, LookKind, View


@dataclass(frozen=True, kw_only=True)
class SecondLookConfig:
    """Which other looks may be taken before an unsure part is declined: views in this order, pushes after them.

    ``exposures`` multiply the usual exposure time, ``nudges`` is how often one part may be pushed. A run takes at most
    ``max_looks`` other looks, and none once they have taken ``max_s`` of the robot's time. After several looks a
    reading must be more probable than ``agree_above``, besides being accepted in one of them. ``same_place_m``: what
    is seen within this distance of where something was seen is the same thing.
    """

    looks: tuple[LookKind, ...] = ("exposure", "park", "nudge")
    exposures: tuple[float, ...] = (0.6, 1.6)
    nudges: int = 2
    max_looks: int = 24
    max_s: float = 120.0
    agree_above: float = 0.9
    same_place_m: float = 0.006
    nudge: NudgeConfig = field(default_factory=NudgeConfig)

    def __post_init__(self) -> None:
        for exposure in self.exposures:
            if not (np.isfinite(exposure) and exposure > 0) or exposure == 1.0:
                raise ValueError(f"exposure {exposure} must be positive, and another one than the usual, 1")
        if len(set(self.looks)) != len(self.looks):
            raise ValueError(f"looks are {', '.join(self.looks)}; name each once, in the order in which to take them")
        if self.nudges < 0 or self.max_looks < 0 or not self.max_s >= 0:
            raise ValueError(
                f"nudges {self.nudges}, max_looks {self.max_looks} and max_s {self.max_s} must not be negative"
            )
        if not 0 <= self.agree_above < 1 or not self.same_place_m > 0:
            raise ValueError(
                f"agree_above {self.agree_above} must be a probability below 1 and same_place_m {self.same_place_m} "
                "positive"
            )


@dataclass(kw_only=True, eq=False)
class Doubt:
    """A place with something that was declined: what the newest look of each view showed there, and what was tried."""

    centre: Array
    seen: dict[View, Candidate] = field(default_factory=dict)
    tried: set[View] = field(default_factory=set)
    nudges: int = 0
    open: bool = True


class SecondLooks:
    """Remembers doubtful places over the looks of a run; call ``take_in`` after each look, then ``next`` if need be.

    ``home`` is the view of looks that nothing calls for: the usual one, or another that last showed something to pick.
    """

    def __init__(self, config: SecondLookConfig, *, elsewhere: bool) -> None:
        """``elsewhere`` says that there is another place to park the arm which shows or shades less of the board."""
        self.config = config
        views = {
            "exposure": [View(exposure=e) for e in config.exposures],
            "park": [View(elsewhere=True)] if elsewhere else [],
            "nudge": [],
        }
        self._views = [USUAL, *(view for kind in config.looks for view in views[kind])]
        self.home = USUAL
        self._doubts: list[Doubt] = []
        self._shown: dict[View, list[Array]] = {}
        self._looks, self._seconds = 0, 0.0
        self.accepted = 0

    @property
    def unsure(self) -> int:
        """How many places are in doubt."""
        return sum(doubt.open for doubt in self._doubts)

    def take_in(self, view: View, candidates: Sequence[Candidate], others: Sequence[Array] = ()) -> list[Candidate]:
        """What a look showed, without what other looks at the same place speak against.

        ``others`` are the places (2,) of what it showed besides, that no push may touch.
        ``accepted`` then says how many doubtful places it settled so that there is something to pick. A look
        from ``home`` shows what there is: a doubt about a place where it finds nothing is dropped.
        """
        self._shown[view] = [*(candidate.centre for candidate in candidates), *others]
        found: dict[int, Doubt] = {}
        out = []
        self.accepted = 0
        for candidate in candidates:
            doubt = self._at(candidate.centre)
            if doubt is None and candidate.unsure:
                doubt = Doubt(centre=candidate.centre)
                self._doubts.append(doubt)
            if doubt is not None:
                found[id(doubt)] = doubt
                candidate = self._weigh(doubt, view, candidate)
            out.append(candidate)
        for doubt in self._doubts:
            doubt.tried.add(view)
        if view == self.home:
            self._doubts = [doubt for doubt in self._doubts if id(doubt) in found]
        return out

    def next(
        self, view: View, candidates: Sequence[Candidate], plan: Callable[[Candidate, list[Array]], Nudge | str]
    ) -> View | Nudge | None:
        """The look to take after one of ``view`` that showed nothing to pick; None when there is none to take.

        ``plan`` makes a push of a candidate past all else that any view has shown, or says why there is none. Pushes
        are planned on looks from ``home`` only: where others have come in between, such a one comes first.
        """
        doubts = [doubt for doubt in self._doubts if doubt.open]
        config = self.config
        if not doubts or self._looks >= config.max_looks or self._seconds >= config.max_s:
            return None
        for other in self._views:
            if any(other not in doubt.tried for doubt in doubts):
                return other
        if "nudge" not in config.looks or all(doubt.nudges >= config.nudges for doubt in doubts):
            return None
        return self._push(candidates, plan) if view == self.home else self.home

    def looked(self, seconds: float) -> None:
        """Count a look that ``next`` asked for and that took so long."""
        self._looks, self._seconds = self._looks + 1, self._seconds + seconds

    def pushed(self, nudge: Nudge) -> None:
        """What was nudged lies elsewhere now: what was seen of it no longer counts."""
        self._vacate(nudge.centre)
        if doubt := self._at(nudge.centre):
            doubt.centre, doubt.nudges, doubt.seen = nudge.centre_after, doubt.nudges + 1, {}

    def forget(self, centre: Array) -> None:
        """Drop the doubt about a place (2,) that the hand has been at."""
        self._vacate(centre)
        doubt = self._at(centre)
        self._doubts = [other for other in self._doubts if other is not doubt]

    def _weigh(self, doubt: Doubt, view: View, candidate: Candidate) -> Candidate:
        """The candidate, declined when the other looks at the place make its reading less than probable."""
        doubt.centre, doubt.seen[view] = candidate.centre, candidate
        probability = agreement(candidate.readings[0], [seen.readings for seen in doubt.seen.values()])
        if candidate.problem is None and probability < self.config.agree_above:
            note = f"looks disagree: probability {probability:.2f} over {len(doubt.seen)} looks"
            candidate = replace(candidate, problem=("declined", note))
        self.accepted += doubt.open and candidate.problem is None
        doubt.open = candidate.unsure
        return candidate

    def _push(
        self, candidates: Sequence[Candidate], plan: Callable[[Candidate, list[Array]], Nudge | str]
    ) -> Nudge | None:
        nudges = []
        for candidate in candidates:
            doubt = self._at(candidate.centre)
            if doubt is None or not doubt.open or doubt.nudges >= self.config.nudges:
                continue
            seen = [other for shown in self._shown.values() for other in shown]
            nudge = plan(candidate, [other for other in seen if not self._near(other, candidate.centre)])
            if isinstance(nudge, Nudge):
                nudges.append((doubt.nudges, -nudge.free_m, nudge))
        return min(nudges, key=lambda n: n[:2])[2] if nudges else None

    def _vacate(self, centre: Array) -> None:
        """Nothing that was shown at a place is there any more."""
        for view, shown in self._shown.items():
            self._shown[view] = [other for other in shown if not self._near(other, centre)]

    def _near(self, a: Array, b: Array) -> bool:
        return float(np.linalg.norm(a - b)) < self.config.same_place_m

    def _at(self, centre: Array) -> Doubt | None:
        near = [(float(np.linalg.norm(doubt.centre - centre)), doubt) for doubt in self._doubts]
        distance, doubt = min(near, key=lambda n: n[0], default=(np.inf, None))
        return doubt if distance < self.config.same_place_m else None
