"""The table of docs/choosing-a-model.md, from catalog and memory planner: `python tools/model_table.py --write`."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

from freegeo.cli.models import VIEWS, needs_of
from freegeo.models import catalog
from freegeo.models.spec import ModelEntry, ModelSpec

PAGE = Path(__file__).parents[1] / "docs" / "choosing-a-model.md"
PLACE = re.compile(r"(<!-- made by tools/model_table\.py -->\n\n)(.*?)(\n\n<!-- end -->)", re.DOTALL)
MEMORY = tuple(f"{views} photos" for views in VIEWS)
HEADER = ("model", "licence of the weights", "download", *MEMORY, "to adapt", "takes", "gives")


def entries() -> list[ModelEntry]:
    """Return the models of the package, without those of installed plug-ins."""
    return [item for family in catalog.FAMILIES for item in importlib.import_module(family).ENTRIES]


def known_cells(item: ModelEntry) -> tuple[str, str, str]:
    """Return what the catalog says of a model: name, licence of the weights, size of the download."""
    download = "in the package" if item.packaged_weights else gigabytes(item.download_bytes)
    # What is said in brackets about a licence stands below the table.
    return f"`{item.name}`", item.licence.partition(" (")[0], download


def row(item: ModelEntry) -> tuple[str, ...]:
    """Return the cells of a model."""
    needs, spec = needs_of(item.name), catalog.build_empty(item.name).spec
    adapting = "no" if needs.adapt is None else " or ".join(map(gigabytes, needs.adapt))
    memory = (gigabytes(size) for size in needs.reconstruct.values())
    return *known_cells(item), *memory, adapting, takes(spec), gives(spec)


def takes(spec: ModelSpec) -> str:
    """Return what a model is given."""
    known = {"nothing": "", "cameras": ", cameras of all", "parts": ", cameras and depth of some"}
    return f"photos{known[spec.takes]}" if spec.cameras else "photos one by one"


def gives(spec: ModelSpec) -> str:
    """Return what a model predicts."""
    return ("depth, cameras" if spec.cameras else "depth") + (", in metres" if spec.metric else "")


def gigabytes(size: float) -> str:
    """Return a number of bytes as text."""
    return f"{size / 1e9:.1f} GB" if size >= 5e7 else "below .1 GB"


def table() -> str:
    """Return the whole table in markdown."""
    rows = [HEADER, ("---",) * len(HEADER), *map(row, entries())]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows)


if __name__ == "__main__":
    if "--write" in sys.argv[1:]:
        text, places = PLACE.subn(lambda place: place[1] + table() + place[3], PAGE.read_text(encoding="utf-8"))
        if places != 1:
            sys.exit(f"{PAGE}: the two comments around the table are missing.")
        PAGE.write_text(text, encoding="utf-8")
    else:
        print(table())
