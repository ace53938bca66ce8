"""Tables and numbers as the pages of docs/ have them."""

from collections.abc import Iterable, Sequence

import numpy as np

from freegeo.metrics.bootstrap import paired_interval

DOMAINS = ("test-id", "big", "tex", "sparse", "light")


def in_order(domains: Iterable[str]) -> list[str]:
    """Kinds of rooms in the order of the pages, each once."""
    return sorted(set(domains), key=lambda name: (DOMAINS.index(name) if name in DOMAINS else len(DOMAINS), name))


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("|" + "|".join("---" if cell == "---" else f" {cell} " for cell in line) + "|" for line in lines)


def plain(value: float, digits: int = 3) -> str:
    """A number without the zero before its point."""
    return f"{value:.{digits}f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.{digits}f}"


def signed(value: float, digits: int = 3) -> str:
    """A change: with its sign unless it is rounded to zero."""
    if float(f"{value:.{digits}f}") == 0:
        return plain(0.0, digits)
    return ("+" if value > 0 else "-") + plain(abs(value), digits)


def interval(changes: Sequence[float] | np.ndarray, clusters: Sequence[object] | None = None, digits: int = 3) -> str:
    """Mean of changes and its 95 % interval."""
    found = paired_interval(changes, clusters)
    return f"{signed(found.mean, digits)} [{signed(found.low, digits)}, {signed(found.high, digits)}]"


def mean_and_worst(changes: Sequence[float] | np.ndarray) -> str:
    """Mean of changes, and the least of them in brackets."""
    return f"{signed(float(np.mean(changes)))} ({signed(float(np.min(changes)))})"


def change(changes: Sequence[float] | np.ndarray) -> str:
    """Mean of changes, its 95 % interval, and the least of them in brackets."""
    return f"{interval(changes)} ({signed(float(np.min(changes)))})"
