"""Tables and figures as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

UNKNOWN = "-"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; the first column to the left, the others to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many digits that count, a dash when it is not known."""
    if value is None:
        return UNKNOWN
    if isinstance(value, int) or abs(value) >= 10 ** (digits - 1):
        return f"{value:.0f}"
    return f"{value:#.{digits}g}".rstrip(".") if value else "0"


def share(value: float | None) -> str:
    """A share in per cent."""
    return UNKNOWN if value is None else f"{100 * value:.1f} %"


def interval(bounds: Sequence[float | None] | None) -> str:
    """A pair of bounds."""
    return UNKNOWN if bounds is None else f"{number(bounds[0])} to {number(bounds[1])}"
