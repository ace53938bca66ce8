"""`freegeo models`: what there is, what it costs, and whether a file fits."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from freegeo.cli import console
from freegeo.errors import FreeGeoError
from freegeo.models import catalog
from freegeo.progress import progress_bar

if TYPE_CHECKING:
    from freegeo.models.api import ReconstructionModel
    from freegeo.models.spec import ModelEntry

logger = logging.getLogger(__name__)
app = App(name="models", help="List, describe, download and check models.", help_format="plaintext")
TABLE_WIDTH = 100
RANKS = (8, 16, 32, 64)
VIEWS = 8
TAKES = {
    "nothing": "photos alone; known cameras are used afterwards",
    "cameras": "photos, and the poses together with the intrinsics of all of them",
    "parts": "photos, and poses or intrinsics or both, of all of them or of some",
}


@app.default
def list_models() -> None:
    """List all models that can be used."""
    header = ("model", "licence", "download", "memory", "about")
    rows = []
    for name in catalog.names():
        try:
            rows.append(_row(name))
        except Exception as error:
            told = catalog.broken(name, error)
            if not isinstance(told, FreeGeoError):
                raise
            logger.warning("%s", told)
    console.say(console.table(header, rows, prose=TABLE_WIDTH))
    console.say("\nLicences are those of the weights; memory is what reconstructing 8 photos takes.")
    console.say("`freegeo models describe NAME` says more about one model.")


def _row(name: str) -> tuple[str, str, str, str, str]:
    item = catalog.entry(name)
    # Details follow after a bracket in licences and after a semicolon in descriptions.
    licence, about = item.licence.partition(" (")[0], item.about.partition(";")[0]
    return name, licence, _download(item), _gigabytes(reconstruction_bytes(catalog.build_empty(name))), about


def _download(item: ModelEntry) -> str:
    if item.hub_id is not None:
        return _gigabytes(item.download_bytes)
    return "included" if item.packaged_weights else "none"


def _gigabytes(size: float) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 5e7 else "< 0.1 GB"


def reconstruction_bytes(model: ReconstructionModel) -> int:
    """Predict the memory that 8 photos of 4:3 need together."""
    from freegeo.adaptation.memory import plan_reconstruction
    from freegeo.models.precision import Compute

    # A budget that no result exceeds; the planner takes long for one that is far larger.
    budget = 1000 * sum(parameter.numel() for parameter in model.parameters())
    parts, _ = plan_reconstruction(model, VIEWS, image_hw(model), compute=Compute(), budget=budget)
    return sum(size for _, size in parts)


def adaptation_bytes(model: ReconstructionModel) -> tuple[int, int]:
    """Predict the memory of adapting to 8 photos of 4:3 in bf16 on a GPU: as fast as possible, and as small."""
    import torch

    from freegeo.adaptation.memory import Footprint
    from freegeo.adaptation.recipe import SEED, scene
    from freegeo.adaptation.samples import SceneImages
    from freegeo.adaptation.views import schedule
    from freegeo.models.precision import Compute

    recipe, (height, width) = scene(model.spec), image_hw(model)
    photos = SceneImages(name="photos", count=VIEWS, load=lambda frames: torch.empty(len(frames), 3, height, width))
    compute = Compute(device=torch.device("cuda"), precision="bf16")
    job = Footprint(model, [photos], recipe, schedule([VIEWS], recipe, SEED), compute)
    return job.plan("device", checkpointing=False).peak_bytes, job.plan("disk", checkpointing=True).peak_bytes


def image_hw(model: ReconstructionModel) -> tuple[int, int]:
    """Return the size of a 4:3 photo after preprocessing."""
    side, patch = model.spec.default_side, model.spec.patch_size
    return round(side * 3 / 4 / patch) * patch, side


@app.command
def describe(model: str) -> None:
    """Say what a model is, where its weights come from, how much memory it needs, and what an adapter of it trains.

    Parameters
    ----------
    model
        Name or hub id of a model.
    """
    from freegeo.adaptation.adapter import count_trainable

    item = catalog.entry(model)
    built = catalog.build_empty(model)
    spec, (height, width) = built.spec, image_hw(built)
    console.say(f"{item.name}: {item.about}")
    console.say(f"licence of the weights: {item.licence}")
    source = f"{item.hub_id}, {item.hub_file}" if item.hub_id else item.packaged_weights or "local file (--checkpoint)"
    console.say(f"weights: {source}")
    console.say(f"parameters: {sum(parameter.numel() for parameter in built.parameters()):,}")
    if item.hub_id:
        console.say(f"download: {_gigabytes(item.download_bytes)}")
        _say_pins(item)
    needed = _gigabytes(reconstruction_bytes(built))
    memory = f"memory for {VIEWS} photos of 4:3 ({width} x {height}): {needed} to reconstruct"
    if built.cross_view is not None:
        fast, small = adaptation_bytes(built)
        memory += f"; to adapt on a GPU {_gigabytes(fast)}, or {_gigabytes(small)} where that does not fit"
    console.say(memory)
    console.say(f"images: longest side {spec.default_side}, patches of {spec.patch_size}")
    console.say(f"lengths: {'metres' if spec.metric else 'up to scale'}")
    console.say(f"takes: {TAKES[spec.takes]}")
    if spec.caution:
        console.say(spec.caution)
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
    from freegeo.training.state import trained_model

    reported = CAMERA_DOMAINS if cameras else REPORTED_DOMAINS
    names = reported if domains is None else tuple(name.strip() for name in domains.split(","))
    if rooms < 1:
        raise UserError(f"--rooms must be at least 1, got {rooms}.")
    require_writable(output.parent)
    for name in names:
        get_domain(name).seeds(rooms)
    if checkpoint and catalog.entry(model).name == catalog.EMBEDDED_MODEL:
        loaded = trained_model(checkpoint)
    else:
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
