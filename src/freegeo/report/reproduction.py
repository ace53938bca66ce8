"""The page of `freegeo bench reproduce`: the paper's tables with ours beside them."""

from __future__ import annotations

from typing import Any

from freegeo.report.rendering import fill

TEMPLATE = "reproduction.html.j2"


def render(page: Any) -> str:
    """The page as text, made from a `freegeo.benchmark.paper.reproduction.Reproduction`."""
    return fill(TEMPLATE, page=page)
