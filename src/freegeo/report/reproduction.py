"""The page of `freegeo bench reproduce`: the paper's tables with ours beside them."""

from __future__ import annotations

from typing import Any

TEMPLATE = "reproduction.html.j2"


def render(page: Any) -> str:
    """The page as text, made from a `freegeo.benchmark.paper.reproduction.Reproduction`; values are escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("freegeo.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template(TEMPLATE).render(page=page)
