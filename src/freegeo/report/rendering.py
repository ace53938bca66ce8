"""Templates of pages as HTML, for the report, the overview of a batch, and the app."""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

_CODE = re.compile(r"`([^`\n]+)`")


def fill(template: str, *, package: str = "freegeo.report", **values: Any) -> str:
    """Return a template of a package with its values; values such as names of photos are escaped.

    Templates have the filter `marked` for sentences that the command line prints as they are.
    """
    return _environment(package).get_template(template).render(**values)


@cache
def _environment(package: str) -> Environment:
    """Return what keeps the templates of a package compiled."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(package), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["marked"] = marked
    return environment


def marked(sentence: object) -> Markup:
    """Return a sentence as HTML: escaped, and with what stands between backticks as code."""
    from markupsafe import Markup, escape

    return Markup(_CODE.sub(r"<code>\1</code>", str(escape(sentence))))


def duration(seconds: float) -> str:
    """Return a time as text: 12 s, 3 min, 1.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
