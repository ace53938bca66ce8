"""`freegeo models`: what there is, what it costs, and whether a file fits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from freegeo.cli import console
from freegeo.host import gigabytes
from freegeo.models import catalog
from freegeo.models.spec import ModelEntry
from freegeo.progress import progress_bar

app = App(name="models", help="List, describe, download and check models.", help_format="plaintext")
TABLE_WIDTH = 100
RANKS = (8, 16, 32, 64)
VIEWS = (8, 32, 100)
"""Numbers of photos whose reconstruction is planned."""
ADAPTED_VIEWS = 8
TAKES = {
    "nothing": "photos alone; known cameras are used afterwards",
    "cameras": "photos, and the poses together with the intrinsics of all of them",
    "parts": "photos, and poses or intrinsics or both, of all of them or of some",
}


@dataclass(frozen=True, kw_only=True)
class ModelNeeds:
    """What a model needs, in bytes; memory as the planner predicts it for photos of 4:3 on a GPU in bf16."""

    entry: ModelEntry
    """Name, licence, description, and where the weights are."""
    parameters: int
    """Parameters in memory; parts of a checkpoint that are not built do not count."""
    download: int | None
    """Size of the download; None: the weights are in the package, or are given with --checkpoint."""
    image_hw: tuple[int, int]
    """Size of a photo of 4:3 after preprocessing."""
    reconstruct: Mapping[int, int]
    """Number of photos -> memory of reconstructing them together."""
    adapt: tuple[int, int] | None
    """Memory of adapting to 8 photos, as fast as possible and as small; None: the model cannot be adapted."""


def needs_of(name: str) -> ModelNeeds:
    """Return what one model needs, also for the table in the docs. Errors as `catalog.entry`, `catalog.build_empty`."""
    import torch

    from freegeo.adaptation.memory import Footprint
    from freegeo.adaptation.recipe import scene
    from freegeo.models.memory import plan_reconstruction
    from freegeo.models.precision import Compute

    item, model = catalog.entry(name), catalog.build_empty(name)
    gpu = Compute(device=torch.device("cuda"), precision="bf16")  # which need not be there to plan for it
    side, patch = model.spec.default_side, model.spec.patch_size
    image_hw = round(side * 3 / 4 / patch) * patch, side
    parameters = sum(parameter.numel() for parameter in model.parameters())
    # A budget that no result exceeds; the planner takes long for one that is far larger.
    plans = {
        views: plan_reconstruction(model, views, image_hw, compute=gpu, budget=1000 * parameters) for views in VIEWS
    }
    adapt = None
    if model.cross_view is not None:
        job = Footprint.of_scene(model, ADAPTED_VIEWS, image_hw, scene(model.spec), gpu)
        adapt = job.plan("device", checkpointing=False).peak_bytes, job.plan("disk", checkpointing=True).peak_bytes
    return ModelNeeds(
        entry=item,
        parameters=parameters,
        download=None if item.hub_id is None else item.download_bytes,
        image_hw=image_hw,
        reconstruct={views: sum(size for _, size in parts) for views, (parts, _) in plans.items()},
        adapt=adapt,
    )


@app.default
def list_models() -> None:
    """List all models that can be used."""
    found = catalog.for_each(needs_of)
    about = [(needs.entry.name, _about(needs.entry)) for needs in found]
    console.say(console.table(("model", "about"), about, prose=TABLE_WIDTH))
    header = ("model", "parameters", "licence", "download", *(f"{views} views" for views in VIEWS))
    console.say("\n" + console.table(header, map(_row, found)))
    console.say("\nLicences are those of the weights. Views: memory for reconstructing so many photos of 4:3 at once,")
    console.say("on a GPU in bf16, by the planner; a CPU takes the same for 8 and up to a sixth more for 100.")
    console.say("`freegeo models describe NAME` says more about one model, and what adapting takes.")


# Details follow after a semicolon in descriptions and after a bracket in licences.
def _about(item: ModelEntry) -> str:
    return item.about.partition(";")[0]


def _row(needs: ModelNeeds) -> tuple[str, ...]:
    licence = needs.entry.licence.partition(" (")[0]
    memory = map(gigabytes, needs.reconstruct.values())
    return needs.entry.name, f"{needs.parameters / 1e6:,.0f} M", licence, _download(needs), *memory


def _download(needs: ModelNeeds) -> str:
    if needs.download is not None:
        return gigabytes(needs.download)
    return "included" if needs.entry.packaged_weights else "none"


@app.command
def describe(model: str) -> None:
    """Say what a model is, where its weights come from, how much memory it needs, and what an adapter of it trains.

    Parameters
    ----------
    model
        Name or hub id of a model.
    """
    from freegeo.adaptation.adapter import count_trainable

    needs = needs_of(model)
    item, built, (height, width) = needs.entry, catalog.build_empty(model), needs.image_hw
    spec = built.spec
    console.say(f"{item.name}: {item.about}")
    console.say(f"licence of the weights: {item.licence}")
    source = f"{item.hub_id}, {item.hub_file}" if item.hub_id else item.packaged_weights or "local file (--checkpoint)"
    console.say(f"weights: {source}")
    console.say(f"parameters: {needs.parameters:,}")
    console.say(f"download: {_download(needs)}")
    if item.hub_id:
        _say_pins(item)
    memory = ", ".join(f"{gigabytes(size)} for {views}" for views, size in needs.reconstruct.items())
    console.say(f"memory to reconstruct photos of 4:3 ({width} x {height}), on a GPU in bf16 by the planner: {memory}")
    if needs.adapt is not None:
        fast, small = map(gigabytes, needs.adapt)
        less = "" if small == fast else f", or {small} where that does not fit"
        console.say(f"memory to adapt to {ADAPTED_VIEWS} of them: {fast}{less}")
    console.say(f"images: longest side {spec.default_side}, patches of {spec.patch_size}")
    console.say(f"takes: {TAKES[spec.takes] if spec.cameras else 'photos, one by one'}")
    console.say(f"gives: depth and its confidence{', poses and intrinsics' if spec.cameras else ''}")
    console.say(f"lengths: {'metres' if spec.metric else 'up to scale'}")
    for sentence in filter(None, (spec.caution, spec.adaptation.caution)):
        console.say(sentence)
    if built.cross_view is None:
        console.say("adapter: none, since it looks at each photo by itself")
        return
    console.say(
        f"reference view: {spec.reference}; features compared at layers {', '.join(map(str, spec.loss_layers))}"
    )
    token = "" if built.camera_token_name is None else " and the camera token"
    console.say(f"adapter: {len(built.adapter_targets())} linear layers{token}")
    console.say(
        console.table(("rank", "trainable parameters"), [(str(r), f"{count_trainable(built, r):,}") for r in RANKS])
    )


def _say_pins(item: ModelEntry) -> None:
    """Say which file of the hub is the right one, and what a file on this machine has."""
    from freegeo.models.hub import local_file

    pins = [f"{word} {value}" for word, value in (("revision", item.revision), ("SHA-256", item.sha256)) if value]
    console.say(f"pinned: {', '.join(pins) or 'nothing; the file of the first download counts from then on'}")
    if found := local_file(item):
        console.say("on this machine: revision {}, SHA-256 {}".format(*found))


@app.command
def download(model: str) -> None:
    """Download a model's weights from the hub; an interrupted download continues, a damaged file is replaced.

    Parameters
    ----------
    model
        Name or hub id of a model.
    """
    item = catalog.entry(model)
    console.say(f"licence of the weights: {item.licence}")
    console.say(str(catalog.download(model, check_hash=True)))


@app.command
def check(model: str, checkpoint: Path) -> None:
    """Check that a local weight file fits a model, without loading it into memory where the format allows.

    Parameters
    ----------
    model
        Name or hub id of a model.
    checkpoint
        File or folder.
    """
    from freegeo.models import checkpoints

    path = checkpoints.find_file(checkpoint)
    item = catalog.entry(model)
    checkpoints.require_fit(catalog.build_empty(model), path, item.keys, item.name)
    console.say(f"{path}: fits {item.name} (fingerprint {checkpoints.fingerprint(path)})")


@app.command
def score(
    model: str,
    *,
    checkpoint: Path | None = None,
    output: Annotated[Path, Parameter(name=("--output", "-o"))] = Path("report-card.json"),
    domains: str | None = None,
    rooms: int = 200,
    cameras: bool = False,
) -> None:
    """Score a model on generated rooms: 4 views, 8 views, and 4 views read off the features of 8.

    These are the report cards of docs/embedded-model.md; they run on the CPU.

    Parameters
    ----------
    model
        Name or hub id of a model.
    checkpoint
        Local weight file or folder, such as the one that `freegeo train-tiny` writes.
    output
        Where the numbers are written as JSON.
    domains
        Kinds of rooms, separated by commas, the kind of the training first; default: all that are reported.
    rooms
        Rooms of each domain.
    cameras
        Score instead what the true cameras are worth: 4 and 8 views without cameras and with them.
    """
    from freegeo.cli.options import use_few_threads
    from freegeo.data.procedural import get_domain
    from freegeo.errors import UserError
    from freegeo.files import require_writable
    from freegeo.training.camera_card import CAMERA_DOMAINS, camera_card, camera_tables
    from freegeo.training.report_card import REPORTED_DOMAINS, card_tables, gate_lines, report_card

    reported = CAMERA_DOMAINS if cameras else REPORTED_DOMAINS
    names = reported if domains is None else tuple(name.strip() for name in domains.split(","))
    if rooms < 1:
        raise UserError(f"--rooms must be at least 1, got {rooms}.")
    require_writable(output.parent)
    for name in names:
        get_domain(name).seeds(rooms)
    loaded = catalog.load_model(model, checkpoint=checkpoint)
    if not loaded.spec.cameras:
        raise UserError(f"{loaded.spec.name} predicts no cameras, which the report card scores. Choose another model.")
    use_few_threads(loaded)
    with progress_bar("domains", len(names)) as update:
        card = (camera_card if cameras else report_card)(
            loaded, output, side=loaded.spec.default_side, domains=dict.fromkeys(names, rooms),
            on_domain=lambda name: update(names.index(name), name),
        )  # fmt: skip
    console.say(camera_tables(card) if cameras else "\n".join([card_tables(card), *gate_lines(card)]))
    console.say(f"numbers: {output}")
