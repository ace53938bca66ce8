"""Options that several commands share. Every default of the command line is written here, once."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from cyclopts import Parameter

from freegeo.adaptation.recipe import PAPER, SEED, DatasetName, Recipe, RecipeName, named, require_seed
from freegeo.cli import console
from freegeo.cli.sources import DEMO
from freegeo.errors import UserError
from freegeo.models.catalog import DEFAULT_MODEL, EMBEDDED_CAUTION, EMBEDDED_MODEL, entry
from freegeo.models.spec import MIXED, Mixed
from freegeo.sequence.chunks import OrderRule

logger = logging.getLogger(__name__)

Refine = Literal["auto", "ba", "off"]
"""Whether bundle adjustment of matches between the photos follows (docs/refinement.md); `auto`: where its extra is
installed."""
SMALL_MODEL = 20_000_000
"""Parameters below which a model runs on one CPU thread."""

if TYPE_CHECKING:
    from freegeo.cameras.known import KnownCameras
    from freegeo.models.api import ReconstructionModel
    from freegeo.models.precision import Compute
    from freegeo.models.spec import ModelSpec
    from freegeo.runs import SequenceWish
    from freegeo.types import PhotoLike


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Which model runs, and where."""

    model: str | None = None
    """Name (`freegeo models`) or hub id of a model, or a plug-in's name; default: da3-base."""
    checkpoint: Path | None = None
    """Local weight file or folder, instead of the download."""
    device: str | None = None
    """cpu, cuda, cuda:N or mps; default: the best at hand."""
    precision: Literal["fp32", "bf16", "fp16"] | None = None
    """Arithmetic of the network: fp32 is exact, the others are faster; default: bf16 on CUDA, else fp32."""
    seed: int = SEED
    """Number that decides everything random."""
    reference: str | None = None
    """Reference view of predictions: first, middle, saddle_balanced, saddle_sim_range; default: the model's rule."""

    @property
    def name(self) -> str:
        """The model's name in the catalog; UserError for an unknown one."""
        return entry(self.model or DEFAULT_MODEL).name

    def for_adapter(self, adapter: Path) -> Self:
        """Return the options with the model that an adapter was made for; UserError when --model names another."""
        made_for = model_of_adapter(adapter, self.model)
        if self.model is None:
            console.note(f"model: {made_for}, which the adapter was made for")
        return replace(self, model=made_for)

    def warn_of_embedded(self, sources: Sequence[str]) -> None:
        """Say what the embedded model is not for, when it is used on photos other than the demo's."""
        if self.name == EMBEDDED_MODEL and any(source != DEMO for source in sources):
            logger.warning("%s", EMBEDDED_CAUTION)

    def load(self) -> ReconstructionModel:
        """Load the model."""
        from freegeo.models.catalog import load_model

        model = load_model(self.name, checkpoint=self.checkpoint)
        use_few_threads(model)
        return model

    def compute(self) -> Compute:
        """Return where adaptation and reconstruction run, and in which precision."""
        from freegeo.models.precision import Compute

        return Compute.choose(self.device, self.precision)

    def build_empty(self) -> ReconstructionModel:
        """Build the model without weights, which reads photos and knows its properties; checks the options first."""
        from freegeo.models.catalog import build_empty
        from freegeo.models.reference import require_no_choice, require_rule
        from freegeo.models.spec import NO_REFERENCE

        self.compute()
        require_seed(self.seed)
        if self.reference is not None:
            require_rule(self.reference)
        model = build_empty(self.name)
        if self.reference is not None and model.spec.reference == NO_REFERENCE:
            require_no_choice(self.reference, model.spec.name)
        return model

    def weights(self) -> Path:
        """Return the weight file, which is downloaded where needed."""
        from freegeo.models.catalog import weights_file

        return weights_file(self.name, self.checkpoint)

    @cached_property
    def fingerprint(self) -> str:
        """Fingerprint of the weight file, which is looked up (and downloaded) once."""
        from freegeo.models.checkpoints import fingerprint

        return fingerprint(self.weights())

    def origin(self) -> dict[str, Any]:
        """Return what reconstruction.json says of the weights; local ones are read whole, for their SHA-256."""
        from freegeo.models.catalog import origin_of

        return origin_of(self.name, self.checkpoint).weights()

    def identity(self, recipe: Recipe | None) -> dict[str, object]:
        """Return what a result depends on, for comparison with an existing folder."""
        from freegeo.runs import identity

        return identity(self.name, self.fingerprint, self.compute(), recipe, self.seed)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DemoModelOptions(ModelOptions):
    """A class of its own, since the parser takes the defaults of options that are left out from the class."""

    model: str = EMBEDDED_MODEL
    """Name (`freegeo models`) or hub id of a model, or a plug-in's name."""


def model_of_adapter(adapter: Path, model: str | None) -> str:
    """Return the catalog name of the model that an adapter was made for; `model` is what --model says.

    UserError when the folder holds no adapter, when --model names another model, and when neither says which it is.
    """
    from freegeo.adaptation.adapter_files import adapter_metadata, read_peft

    read_peft(adapter)
    metadata = adapter_metadata(adapter)
    stated = metadata["base"]["model"] if metadata else model
    if stated is None:
        raise UserError(f"{adapter}: does not say which model it was made for. Name that with --model.")
    made_for = entry(stated).name
    if model is not None and entry(model).name != made_for:
        raise UserError(
            f"{adapter}: the adapter was made for {made_for}, not for {entry(model).name}. Leave --model out."
        )
    return made_for


def refines_with(cameras: CameraOptions, refine: Refine) -> bool:
    """As `refines`, but known cameras are not to be moved: with them `auto` is off, and `ba` is refused."""
    if cameras.cameras is None:
        return refines(refine)
    if refine == "ba":
        raise UserError("--refine ba would move the cameras that are known. Leave out --refine or --cameras.")
    return False


def refines(refine: Refine) -> bool:
    """Whether bundle adjustment follows; UserError where it is asked for and not installed."""
    if refine == "auto":
        return find_spec("pycolmap") is not None
    if refine == "ba":
        from freegeo.evidence.bundle import pycolmap_module

        pycolmap_module()
    return refine == "ba"


def use_few_threads(model: ReconstructionModel) -> None:
    """Run small models on one thread: their matrices are too small to share out, and waiting threads cost more."""
    import torch

    if sum(parameter.numel() for parameter in model.parameters()) < SMALL_MODEL:
        torch.set_num_threads(1)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RecipeOptions:
    """How the model is adapted; options left out come from the recipe."""

    recipe: RecipeName = "scene"
    """Named settings: scene for your own photos; evidence, which also learns cameras from matches between them (needs
    the extra colmap); the others as published, which also need --dataset."""
    dataset: DatasetName | None = None
    """Dataset whose published settings are used, with every recipe but scene and evidence."""
    views: int | None = None
    """Photos in one training example; the model learns to see from some of them what it sees from all. Default: 8."""
    keep: str | None = None
    """Which of these photos it learns to see it from, counted from 0, such as 0,2,4,6. Default: every second one."""
    steps: int | None = None
    """Training steps. Default: 100 with recipe scene, else by --epochs."""
    epochs: int | None = None
    """Passes over all training examples, instead of --steps. Default: 3 to 5, by dataset."""
    sets: int | None = None
    """Training examples drawn from a scene. Default: 10 with recipe scene, else by dataset."""
    lr: float | None = None
    """Highest learning rate. Default: 3e-5 with recipe scene (freegeo-tiny: 1e-3), else by dataset."""
    rank: int | None = None
    """Size of the adapter: rank of its matrices. Default: 32 (freegeo-tiny: 16)."""
    hold: float | None = None
    """How strongly the answer from all photos is held where it was. Default: 1 with scene and evidence, else 0."""
    loss: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = ()
    """Settings of the loss, such as weight_kq=0 or selection=topk,angle_weights=2,2,2; may be given several times."""

    def build(self, spec: ModelSpec) -> Recipe:
        """Return the recipe for a model; UserError when something that it needs is not installed."""
        recipe = named(self.recipe, spec, self.dataset).changed(**self.changes())
        if recipe.cameras:
            refines("ba")
        return recipe

    def changes(self) -> dict[str, Any]:
        """Return what `Recipe.changed` takes: every setting of the recipe, None where the option was left out."""
        return {
            "views": self.views, "keep": parse_keep(self.keep), "steps": self.steps, "epochs": self.epochs,
            "sets_per_scene": self.sets, "lr": self.lr, "rank": self.rank, "hold": self.hold,
            "loss": parse_loss(self.loss),
        }  # fmt: skip


def parse_keep(text: str | None) -> tuple[int, ...] | None:
    """Read positions such as 0,2,4,6."""
    if text is None:
        return None
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"--keep '{text}' is no list of positions. Write it as 0,2,4,6.") from None


def parse_loss(texts: Sequence[str]) -> dict[str, Any]:
    """Read settings of the loss such as weight_kq=0,selection=topk; each value is read as what the paper's is."""
    # A comma separates settings only before another `name=`, since a setting may be a list of numbers.
    return dict(_loss_setting(part) for text in texts for part in re.split(r",(?=\s*\w+\s*=)", text))


def _loss_setting(text: str) -> tuple[str, Any]:
    name, equals, value = (part.strip() for part in text.partition("="))
    if not equals:
        raise UserError(f"--loss '{text}' is no setting. Write it as weight_kq=0.")
    # A name that is none stays text; `LossConfig.changed` lists those that are.
    example = vars(PAPER.loss).get(name, "")
    try:
        return name, _read_like(example, value)
    except ValueError:
        raise UserError(f"--loss {name}: '{value}' is no value like {example}.") from None


def _read_like(example: object, text: str) -> object:
    if isinstance(example, bool):
        return ("false", "true").index(text.lower()) == 1
    if isinstance(example, tuple):
        return tuple(float(part) for part in text.split(","))
    return type(example)(text)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PhotoOptions:
    """Which photos are used, and how."""

    max_views: int | None = None
    """Most photos that are used; of more, as many are chosen evenly. Default: all photos of a folder; of a video 32
    frames, or all that --fps takes."""
    fps: float | None = None
    """Videos: take a frame this often per second; default: by sharpness and parallax."""
    skip_bad: bool = False
    """Leave out photos that cannot be read, with a warning, instead of stopping."""
    mixed: Mixed = MIXED
    """Photos of different shapes: cut the odd ones, pad all with white (nothing is lost), or do as upstream does."""
    process_res: int | None = None
    """Longest side in pixels of what the model sees, rounded to its patches: more shows more detail and takes more
    memory and time. Default: the model's own (`freegeo models describe`); 504 for the published ones."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """Known cameras of the photos."""

    cameras: Path | None = None
    """Known poses and intrinsics, wholly or in part: a file, or a folder such as a COLMAP project (docs/cameras.md)."""
    cameras_format: str | None = None
    """cameras.json, colmap, nerfstudio, tum, kitti or poses; default: by content."""
    cameras_convention: str | None = None
    """How pose matrices are meant: w2c-opencv, c2w-opencv, w2c-opengl or c2w-opengl; default: as the format says."""
    metric: Annotated[bool, Parameter(negative="")] = False
    """Lengths in the camera file are metres."""
    trust_cameras: Annotated[bool, Parameter(negative="")] = False
    """Use poses without checking them by matches between the photos."""

    def read(self, photos: Sequence[PhotoLike]) -> tuple[list[PhotoLike], KnownCameras | None]:
        """Return the photos, without distortion, and their known cameras; UserError for cameras that cannot be used."""
        if self.cameras is None:
            if self.cameras_format or self.cameras_convention or self.metric or self.trust_cameras:
                raise UserError("the options about cameras need the file with these: --cameras FILE.")
            return list(photos), None
        from freegeo.cameras.reading import read_cameras
        from freegeo.posed import known_cameras

        known = read_cameras(
            self.cameras, photos, format=self.cameras_format, metric=self.metric, convention=self.cameras_convention
        )
        return known_cameras(photos, known)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PlacingOptions:
    """What is done with a prediction before points are made of it."""

    one_camera: bool | None = None
    """Photos of one camera (same size and EXIF data) share one focal length; default: for videos only."""
    scale: str | None = None
    """Where metres come from: gps, a measured distance such as "a.jpg:812,410 b.jpg:655,398 = 1.25" (column and row
    of two places, and metres), or a text file of these."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SequenceOptions:
    """How more photos than are predicted at once become one result (docs/sequences.md)."""

    chunk: str = "auto"
    """Photos that are predicted together; of more, chunks are predicted one after the other and joined. auto: as many
    as fit into memory, at most as many as suit the model; in the folder of an earlier run, as many as there."""
    overlap: int | None = None
    """Photos that two neighbouring chunks share. Default: half of a chunk."""
    loops: bool = True
    """Look for places that the photos come back to, and let them correct the way between."""
    order: OrderRule = "auto"
    """Order of the photos: given; similar: by what they show; auto: given, unless neighbours do not look alike."""

    def wish(self) -> SequenceWish:
        """Return what is asked for; UserError for a size of chunks that is none."""
        from freegeo.runs import SequenceWish

        chunk = None if self.chunk == "auto" else self._size()
        return SequenceWish(chunk=chunk, overlap=self.overlap, order=self.order, loops=self.loops)

    def _size(self) -> int:
        if not self.chunk.isdecimal() or int(self.chunk) < 2:
            raise UserError(f"--chunk is auto or a number of photos from 2 on, got '{self.chunk}'.")
        return int(self.chunk)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Where results go."""

    output: Annotated[Path, Parameter(name=("--output", "-o"))]
    """Folder for the results."""
    overwrite: bool = False
    """Replace what an earlier run with other options wrote there."""
