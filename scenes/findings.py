"""What a check of a data set finds: problems that name file, image and remedy, like ones gathered."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

SHOWN = 5
"""Problems of one kind in one file that are told; the others are counted."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Something wrong: ``file`` relative to the data set, the image if it is one's, what, and what mends it."""

    file: str
    image: str
    what: str
    remedy: str

    def __str__(self) -> str:
        where = f"{self.file}, image {self.image}" if self.image else self.file
        return f"{where}: {self.what}; {self.remedy}"


@dataclass(kw_only=True)
class Findings:
    """Problems found so far in the data set at ``root``; ``counts`` of what was looked at."""

    root: Path
    problems: list[Problem] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    _alike: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add(self, path: Path, what: str, remedy: str, image: str | int = "") -> None:
        """Note a problem. Problems with the same remedy in the same file are of one kind."""
        file = path.relative_to(self.root).as_posix() if path.is_relative_to(self.root) else str(path)
        self._alike[file, remedy] += 1
        if self._alike[file, remedy] <= SHOWN:
            self.problems.append(Problem(file=file, image=str(image), what=what, remedy=remedy))

    def told(self) -> list[Problem]:
        """All problems; of each kind the first few and how many more there are."""
        more = [
            Problem(file=file, image="", what=f"{count - SHOWN} more problems like the last", remedy=remedy)
            for (file, remedy), count in self._alike.items()
            if count > SHOWN
        ]
        return [*self.problems, *more]

    def read_json(self, path: Path, remedy: str) -> dict[str, Any] | None:
        """A JSON object, or None when it cannot be read, which is noted."""
        try:
            content = json.loads(path.read_text())
        except FileNotFoundError:
            self.add(path, "is missing", remedy)
        except (OSError, ValueError) as error:
            self.add(path, f"cannot be read: {error}", remedy)
        else:
            if isinstance(content, dict):
                return content
            self.add(path, f"holds a {type(content).__name__}, no JSON object", remedy)
        return None


@dataclass(frozen=True, kw_only=True)
class Report:
    """Outcome of a check: problems, and counts of what was looked at."""

    folder: Path
    problems: tuple[Problem, ...]
    counts: dict[str, int]

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    def to_json(self) -> dict[str, Any]:
        """For machines."""
        problems = [asdict(problem) for problem in self.problems]
        return {"folder": str(self.folder), "ok": self.ok, "counts": self.counts, "problems": problems}

    def __str__(self) -> str:
        checked = ", ".join(f"{count} {name}" for name, count in self.counts.items())
        verdict = "nothing is wrong" if self.ok else f"{len(self.problems)} problems"
        return "\n".join([*map(str, self.problems), f"{self.folder}: {checked}; {verdict}"])
