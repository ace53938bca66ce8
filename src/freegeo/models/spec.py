"""Description of a model, and its entry in the catalog. Importing this file does not import torch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from freegeo.models.api import ReconstructionModel

PoseFrom = Literal["camera", "rays"]
"""Where a model's cameras come from: its camera head, or the rays that it predicts for every pixel."""
Mixed = Literal["crop", "pad", "upstream"]
"""How photos of different shapes become images of one size; the network sees all views in one pass.

`crop`: the size that loses least, mostly that of most photos; those of another shape are scaled to cover it and cut.
`pad`: the largest height and width; nothing is cut, and white fills the rest. `upstream`: the authors' rule.
"""
MIXED: Mixed = "crop"


Takes = Literal["nothing", "cameras", "parts"]
"""What a model can be told of its views.

`cameras`: poses together with intrinsics, of all views or of none. `parts`: any of poses, intrinsics and depth, of all
views or of some.
"""
NO_REFERENCE = "none"
"""Reference-view rule of a model that treats all views alike."""


@dataclass(frozen=True, kw_only=True)
class AdaptationDefaults:
    """Settings of the method that depend on the model's features, published or measured."""

    temperature: float
    """Softmax temperature of the relational loss; about .6 to .8 of the features' rms."""
    scene_lr: float
    """Peak learning rate of the recipe `scene`."""
    rank: int = 32
    neighbours: bool = False
    """Whether the model was trained on neighbouring frames only, so that its view sets are consecutive frames."""
    published: Literal["da3", "vggt"] | None = None
    """Which of the two published families of settings a dataset recipe takes; None: the paper's DA3 column."""
    caution: str | None = None
    """A sentence that everyone who adapts the model has to read."""


@dataclass(frozen=True, kw_only=True)
class ModelSpec:
    """The properties of a model that the rest of the package uses."""

    name: str
    patch_size: int
    default_side: int
    """Longest image side after `preprocess`, in pixels, unless another one is asked for."""
    loss_layers: tuple[int, ...]
    """Layers whose features the losses compare, ascending; the last one carries the relational loss."""
    reference: str
    """Reference-view rule of the frozen model; `NO_REFERENCE` for one that treats all views alike."""
    special_tokens: int
    """Tokens of a view that are no patches."""
    weights_licence: str
    adaptation: AdaptationDefaults
    cameras: bool = True
    """Whether it predicts cameras; without them a result is depth alone."""
    metric: bool = False
    """Whether its lengths are metres."""
    ray_cameras: bool = False
    """Whether it can also find cameras from a ray map."""
    caution: str | None = None
    """A sentence on its results that everyone who uses it has to read."""
    chunk: int = 120
    """Views that are predicted together unless more are asked for: longer sequences are cut into chunks."""
    takes: Takes = "nothing"
    """What the model can be told of its views (`freegeo.types.Priors`)."""
    sides: tuple[int, int] | None = None
    """Smallest and largest side that `preprocess` can be asked for without a warning; None: it has its default only."""


@dataclass(frozen=True, kw_only=True)
class KeyRules:
    """How the names in a checkpoint file become the names of a model's state dict."""

    prefix: str = ""
    """Written in front of every name; of a file that is read, whatever prefix its names share is taken off."""
    skipped: tuple[str, ...] = ()
    """Prefixes (after that) of parts that are not built."""
    aliases: Mapping[str, str] = field(default_factory=dict)
    """Names of a shared tensor that a file may leave out -> the name it is stored under."""
    foreign: Mapping[str, str] = field(default_factory=dict)
    """Names that only files of another model have -> a sentence on what that is."""

    def file_names(self, names: Iterable[str]) -> dict[str, str]:
        """Return our name -> file name for a file that leaves the aliases out."""
        return {name: self.prefix + name for name in names if name not in self.aliases}


@dataclass(frozen=True, kw_only=True)
class ModelEntry:
    """One line of the catalog; a plug-in's entry point names one of these."""

    name: str
    about: str
    licence: str
    """Licence of the weights."""
    parameters: int
    build: Callable[[], ReconstructionModel]
    """Builds the model without weights."""
    keys: KeyRules = KeyRules()
    """Rules that translate the checkpoint's names; by default the names are the model's own."""
    hub_id: str | None = None
    hub_file: str = "model.safetensors"
    revision: str | None = None
    """Commit of the hub's repository; None: what is newest at the first download."""
    sha256: str | None = None
    """SHA-256 of the hub's file, 64 small hexadecimal digits; None: that of the first download counts from then on."""
    gated: bool = False
    """The hub hands the file out only to accounts that accepted its licence."""
    packaged_weights: Path | None = None
    """Weights that come with an installed package."""

    @property
    def download_bytes(self) -> int:
        """Size of the float32 checkpoint."""
        return self.parameters * 4


@dataclass(frozen=True, kw_only=True)
class LoadedFrom:
    """Where a model's weights came from; stored with everything made from them."""

    model: str
    file: str
    fingerprint: str
    licence: str
    sha256: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of the file, or of each part, by its name."""
    hub_id: str | None = None
    """Repository of the hub that the file was downloaded from, and its commit; None for a local file."""
    revision: str | None = None

    def weights(self) -> dict[str, Any]:
        """Return what tells the weights from others, as results record it."""
        return {name: value for name, value in asdict(self).items() if name not in ("model", "licence")}
