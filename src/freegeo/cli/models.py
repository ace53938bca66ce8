"""`freegeo models`: what there is, what it costs, and whether a file fits."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from freegeo.cli import console
from freegeo.models import catalog
from freegeo.progress import progress_bar

app = App(name="models", help="List, describe, download and check models.", help_format="plaintext")
TABLE_WIDTH = 100
RANKS = (8, 16, 32, 64)


@app.default
def list_models() -> None:
    """List all models."""
    rows = [_row(name) for name in catalog.names()]
    console.say(console.table(("model", "parameters", "licence", "about"), rows, prose=TABLE_WIDTH))
    console.say("\nLicences are those of the weights. `freegeo models describe NAME` says more about one model.")


def _row(name: str) -> tuple[str, str, str, str]:
    item = catalog.entry(name)
    # Details follow after a bracket in licences and after a semicolon in descriptions.
    licence, about = item.licence.partition(" (")[0], item.about.partition(";")[0]
    parameters = item.parameters or parameter_count(name)
    return name, f"{parameters / 1e6:,.1f} M", licence, about if item.build else f"not implemented yet: {about}"


def parameter_count(name: str) -> int:
    """Count the parameters of a model built without memory."""
    return sum(parameter.numel() for parameter in catalog.build_empty(name).parameters())


@app.command
def describe(model: str) -> None:
    """Say what a model is, where its weights come from, and what an adapter of it trains.

    Parameters
    ----------
    model
        Catalog name.
    """
    from freegeo.adaptation.adapter import count_trainable

    item = catalog.entry(model)
    console.say(f"{item.name}: {item.about}")
    console.say(f"licence of the weights: {item.licence}")
    console.say(f"weights: {item.hub_id or item.packaged_weights or 'local file (--checkpoint)'}")
    if item.build is None:
        console.say("not implemented yet")
        return
    built = catalog.build_empty(model)
    total = sum(parameter.numel() for parameter in built.parameters())
    spec = built.spec
    console.say(
        f"parameters: {total:,} ({total * 4 / 1e9:.2f} GB in float32, {total * 2 / 1e9:.2f} GB in half precision)"
    )
    console.say(f"images: longest side {spec.default_side}, patches of {spec.patch_size}")
    console.say(
        f"reference view: {spec.reference}; features compared at layers {', '.join(map(str, spec.loss_layers))}"
    )
    console.say(f"adapter: {len(built.adaptable().adapter_targets())} linear layers and the camera token")
    console.say(
        console.table(("rank", "trainable parameters"), [(str(r), f"{count_trainable(built, r):,}") for r in RANKS])
    )


@app.command
def download(model: str) -> None:
    """Download a model's weights from the hub; an interrupted download continues.

    Parameters
    ----------
    model
        Catalog name.
    """
    item = catalog.entry(model)
    console.say(f"licence of the weights: {item.licence}")
    console.say(str(catalog.download(model)))


@app.command
def check(model: str, checkpoint: Path) -> None:
    """Check that a local weight file fits a model, without loading it into memory where the format allows.

    Parameters
    ----------
    model
        Catalog name.
    checkpoint
        File or folder.
    """
    from freegeo.models import checkpoints

    path = checkpoints.find_file(checkpoint)
    item = catalog.entry(model)
    checkpoints.require_fit(catalog.build_empty(model), path, item.keys, model)
    console.say(f"{path}: fits {model} (fingerprint {checkpoints.fingerprint(path)})")


@app.command
def score(
    model: str,
    *,
    checkpoint: Path | None = None,
    output: Annotated[Path, Parameter(name=("--output", "-o"))] = Path("report-card.json"),
    domains: str | None = None,
    rooms: int = 200,
) -> None:
    """Score a model on generated rooms: 4 views, 8 views, and 4 views read off the features of 8.

    This is the report card of docs/embedded-model.md; it runs on the CPU.

    Parameters
    ----------
    model
        Catalog name.
    checkpoint
        Local weight file or folder, such as the one that `freegeo train-tiny` writes.
    output
        Where the numbers are written as JSON.
    domains
        Kinds of rooms, separated by commas, the kind of the training first; default: all that are reported.
    rooms
        Rooms of each domain.
    """
    from freegeo.cli.options import use_few_threads
    from freegeo.data.procedural import get_domain
    from freegeo.errors import UserError
    from freegeo.training.report_card import REPORTED_DOMAINS, card_tables, gate_lines, report_card

    names = REPORTED_DOMAINS if domains is None else tuple(name.strip() for name in domains.split(","))
    if rooms < 1:
        raise UserError(f"--rooms must be at least 1, got {rooms}.")
    for name in names:
        get_domain(name).seeds(rooms)
    loaded = catalog.load_model(model, checkpoint=checkpoint)
    use_few_threads(loaded)
    with progress_bar("domains", len(names)) as update:
        card = report_card(
            loaded, output, side=loaded.spec.default_side, domains=dict.fromkeys(names, rooms),
            on_domain=lambda name: update(names.index(name), name),
        )  # fmt: skip
    console.say(card_tables(card))
    console.say("\n".join(gate_lines(card)))
    console.say(f"numbers: {output}")
