"""Adapters on disk: peft's own two files, the camera token, and metadata.

ADAPTER/  adapter_config.json         rank, alpha, target layers                                    peft's format
          adapter_model.safetensors   base_model.model.<layer>.lora_{A|B}.weight, float32           peft's format
          camera_token.safetensors    where the model has a camera token
          freegeo.json                base model and its fingerprint, recipe, seed, scenes, loss curve

The layout of the method's authors (docs/method.md, "Adapter files") is read and written too:

FOLDER/   <name>_lora_peft/           peft's two files; layers are named relative to the part that the authors adapt,
                                      which the model knows (`published_adapter_root`)
          <name>_lora.pt              {"camera_token": tensor}, float32, beside the peft folder
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Required, TypedDict

import torch
from torch import Tensor

from freegeo.adaptation.adapter import Adapter
from freegeo.errors import DamagedError, UserError, in_short
from freegeo.files import FORMAT, atomic_path, read_json, write_json, write_tensors
from freegeo.models.checkpoints import read_tensors, require_match, require_sound

if TYPE_CHECKING:
    from freegeo.models.api import ReconstructionModel

TOKEN, METADATA = "camera_token.safetensors", "freegeo.json"
PEFT_PREFIX = "base_model.model."
CONFIG, WEIGHTS = "adapter_config.json", "adapter_model.safetensors"
ADAPTER_FOLDER = "adapter"
"""Where the output folder of a run keeps its adapter."""
WITHOUT_EFFECT = (
    *("peft_type", "task_type", "auto_mapping", "peft_version", "base_model_name_or_path", "revision"),
    *("inference_mode", "r", "lora_alpha", "lora_dropout", "target_modules", "exclude_modules", "layers_to_transform"),
    *("layers_pattern", "megatron_core", "qalora_group_size", "runtime_config", "ensure_weight_tying"),
    *("loftq_config", "eva_config", "corda_config", "lora_ga_config"),
)
"""Settings of peft under which a saved adapter is W + alpha / r * B A, whatever their value; the rest must be off."""
STARTS_ON_THE_MODEL = (True, False, None, "gaussian", "orthogonal", "eva", "mica")
"""Initialisations of peft that leave the weights of the model as they are."""


LARGEST_STRENGTH = 1_000.0
"""Beyond what anybody chooses; far larger numbers overflow."""
PLAIN_BIAS = ("bias", "none")
LORA_SUFFIX, TOKEN_SUFFIX = "_lora_peft", "_lora.pt"


def save_adapter(adapter: Adapter, folder: Path, metadata: Mapping[str, Any]) -> list[Path]:
    """Write an adapter; `metadata` is what freegeo.json adds to the base model's identity and the adapter's strength.

    Returns the files. The tensors are those of strength 1.
    """
    files = write_peft(adapter, folder)
    if adapter.camera_token is not None:
        write_tensors(folder / TOKEN, {"camera_token": adapter.camera_token.float()})
        files.append(folder / TOKEN)
    write_json(
        folder / METADATA, {"format": FORMAT, "base": _base(adapter.model), "strength": adapter.strength, **metadata}
    )
    return [*files, folder / METADATA]


def load_adapter(model: ReconstructionModel, folder: str | Path) -> Adapter:
    """Attach a saved adapter, on and at its stored strength, for inference; the model is unchanged when this fails.

    Reads our own folders, plain peft folders and the authors' published layout (`find_adapter` says where). UserError
    when the folder is no adapter, when its numbers are not finite, or when it was made for another model (by layer
    names and shapes; a differing fingerprint of the same architecture is an error too).
    """
    folder, model = find_adapter(folder), model.adaptable()
    config, tensors = read_peft(folder)
    metadata = adapter_metadata(folder)
    _require_same_base(model.spec.name, _base(model)["fingerprint"], metadata, folder)
    tensors = own_names(model, tensors) | _camera_token(model, folder)
    adapter = Adapter.attach(
        model,
        rank=config["r"],
        alpha=config["lora_alpha"],
        dropout=0.0,
        generator=torch.Generator(),
        targets=lora_layers(tensors),
        process_res=(metadata or {}).get("process_res"),
    )
    ours = {name: tuple(value.shape) for name, value in adapter.named_parameters().items()}
    if "camera_token" not in tensors:
        ours.pop("camera_token", None)
    try:
        shapes = {name: tuple(value.shape) for name, value in tensors.items()}
        require_match(
            ours, shapes, f"{folder}: this adapter does not fit {model.spec.name}", "Check --model and --adapter."
        )
        adapter.load(tensors)
        for parameter in adapter.parameters():
            parameter.requires_grad_(False)
        adapter.set_strength(float((metadata or {}).get("strength", 1)))
    except BaseException:
        adapter.detach()
        raise
    return adapter


def require_fitting(model: ReconstructionModel, folder: Path, fingerprint: str) -> None:
    """Raise UserError where `load_adapter` would, for a model with weights of this fingerprint.

    The model itself needs no weights (`build_empty`), so that commands can check before they remove or load anything.
    """
    _require_same_base(model.spec.name, fingerprint, adapter_metadata(folder), folder)
    load_adapter(model, folder).detach()


def find_adapter(path: str | Path) -> Path:
    """Return the folder that holds an adapter's files.

    `path` is that folder, one of the two files in it, the output folder of a run, or a folder with one published
    adapter; `~` is the user's home. A path without an adapter comes back as it is, for `read_peft` to refuse. UserError
    when there are several adapters to choose from.
    """
    folder = Path(path).expanduser()
    if folder.name in (CONFIG, WEIGHTS) and folder.is_file():
        return folder.parent
    if (folder / CONFIG).is_file():
        return folder
    if (folder / ADAPTER_FOLDER / CONFIG).is_file():
        return folder / ADAPTER_FOLDER
    published = sorted(file.parent for file in folder.glob(f"*{LORA_SUFFIX}/{CONFIG}"))
    if len(published) > 1:
        raise UserError(f"{folder}: holds several adapters ({', '.join(p.name for p in published)}). Name one of them.")
    return published[0] if published else folder


class _Base(TypedDict):
    model: str
    fingerprint: str


class Metadata(TypedDict, total=False):
    """Content of `METADATA`, as far as it is read again."""

    format: Required[int]
    base: Required[_Base]
    strength: float
    process_res: int | None


def adapter_metadata(folder: Path) -> dict[str, Any] | None:
    """Return freegeo.json of an adapter folder; None for an adapter that freegeo did not write."""
    path = folder / METADATA
    if not path.is_file():
        return None
    try:
        metadata = read_json(path, Metadata)
    except DamagedError as error:
        advice = "Copy the whole folder that `freegeo adapt` wrote."
        raise UserError(f"{path}: does not describe an adapter ({error.reason}). {advice}") from None
    if not abs(metadata.get("strength", 1)) <= LARGEST_STRENGTH:
        raise UserError(f"{path}: the strength is {metadata['strength']:g}, as none is. Copy the whole folder again.")
    if metadata["format"] > FORMAT:
        raise UserError(f"{folder}: written by a newer freegeo (format {metadata['format']}). Update freegeo.")
    return metadata


def _camera_token(model: ReconstructionModel, folder: Path) -> dict[str, Tensor]:
    path = folder / TOKEN
    if path.is_file():
        tensors = read_tensors(path)
        require_sound(tensors, path)
        return tensors
    if model.camera_token_name is None:
        return {}
    if (folder / METADATA).is_file():
        raise UserError(f"{path}: this file of the adapter is missing. Copy the whole folder that freegeo wrote.")
    # A plain peft adapter has no camera token; the authors' always has one.
    folder = folder.absolute()
    return {"camera_token": read_camera_token(folder)} if folder.name.endswith(LORA_SUFFIX) else {}


def _base(model: ReconstructionModel) -> dict[str, Any]:
    loaded = getattr(model, "loaded_from", None)
    weights = loaded.weights() if loaded else {"fingerprint": ""}
    return {"model": model.spec.name, **weights, "licence": model.spec.weights_licence}


def _require_same_base(model: str, fingerprint: str, metadata: Mapping[str, Any] | None, folder: Path) -> None:
    if metadata is None:
        return
    base = metadata["base"]
    if base["model"] != model:
        made_for = in_short(base["model"])
        raise UserError(f"{folder}: the adapter was made for {made_for}, not for {model}. Use that model.")
    if base["fingerprint"] and fingerprint and base["fingerprint"] != fingerprint:
        raise UserError(
            f"{folder}: the adapter was made for another checkpoint of {model} ({in_short(base['fingerprint'])}, this "
            f"is {fingerprint}). Use that checkpoint."
        )


def write_peft(adapter: Adapter, folder: Path, *, root: str = "") -> list[Path]:
    """Write the LoRA part of an adapter, its layers named relative to the module `root` of the model."""
    prefix = f"{root}." if root else ""
    named = {name: value for name, value in adapter.named_parameters().items() if name != "camera_token"}
    tensors = {PEFT_PREFIX + name.removeprefix(prefix): value.float() for name, value in named.items()}
    write_tensors(folder / WEIGHTS, tensors, {"format": "pt"})
    values = adapter.lora_config.to_dict()
    values["target_modules"] = sorted(name.removeprefix(prefix) for name in adapter.layers)
    values["inference_mode"] = True
    values["base_model_name_or_path"] = adapter.model.spec.name
    with atomic_path(folder / CONFIG) as part:
        part.write_text(json.dumps(values, indent=2, sort_keys=True, default=_plain) + "\n", encoding="utf-8")
    return [folder / CONFIG, folder / WEIGHTS]


def read_peft(folder: Path) -> tuple[Mapping[str, Any], dict[str, Tensor]]:
    """Return an adapter's configuration and its tensors `<layer>.lora_{A|B}.weight`.

    UserError when the folder holds no LoRA adapter, one with settings beyond plain LoRA, or one with NaN or infinity.
    """
    if not (folder / CONFIG).is_file() or not (folder / WEIGHTS).is_file():
        raise UserError(
            f"{folder}: not an adapter folder ({CONFIG} and {WEIGHTS} are expected). "
            "Give the folder that `freegeo adapt` wrote, or the output folder of `freegeo run`."
        )
    config = read_json(folder / CONFIG)
    _require_plain_lora(config, folder)
    tensors = read_tensors(folder / WEIGHTS)
    require_sound(tensors, folder / WEIGHTS)
    tensors = {name.removeprefix(PEFT_PREFIX): value for name, value in tensors.items()}
    if not lora_layers(tensors):
        raise UserError(f"{folder / WEIGHTS}: no LoRA matrices in it. Give the folder that `freegeo adapt` wrote.")
    ranks = {value.shape[:1] for name, value in tensors.items() if name.endswith(".lora_A.weight")}
    if ranks != {(config["r"],)}:
        raise UserError(f"{folder}: its matrices are not of the rank {config['r']} that {CONFIG} says. Copy it again.")
    return config, tensors


def _require_plain_lora(config: Any, folder: Path) -> None:
    if not isinstance(config, dict) or config.get("peft_type") != "LORA":
        kind = config.get("peft_type", "different") if isinstance(config, dict) else "different"
        raise UserError(f"{folder}: holds a {in_short(kind)} adapter; only LoRA is supported.")
    rank, alpha = config.get("r"), config.get("lora_alpha")
    if type(rank) is not int or rank < 1 or type(alpha) not in (int, float) or not math.isfinite(alpha):
        raise UserError(f"{folder / CONFIG}: rank and alpha are not those of an adapter. Copy it again.")
    start = config.get("init_lora_weights")
    if start not in STARTS_ON_THE_MODEL:
        raise UserError(
            f"{folder}: the adapter was initialised by {in_short(start)}, which changes the weights of the model "
            "itself; only LoRA on the unchanged model is supported. Convert it with peft (save_pretrained with "
            "path_initial_model_for_weight_conversion)."
        )
    known = {*WITHOUT_EFFECT, "init_lora_weights"}
    special = [name for name, value in config.items() if value and name not in known and (name, value) != PLAIN_BIAS]
    if special:
        used = in_short(", ".join(special))
        raise UserError(f"{folder}: the adapter uses {used}; only plain LoRA of one rank is supported.")


def lora_layers(tensors: Mapping[str, Tensor]) -> list[str]:
    """Return the layers that LoRA matrices belong to, sorted."""
    return sorted({name.rsplit(".lora_", 1)[0] for name in tensors if ".lora_" in name})


def _plain(value: Any) -> Any:
    if isinstance(value, set | frozenset):
        return sorted(value)
    return str(getattr(value, "value", value))


def own_names(model: ReconstructionModel, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return LoRA tensors by their names in the whole model, where a file names them relative to the adapted part."""
    root = model.published_adapter_root
    modules = {name for name, _ in model.named_modules()}
    if not root or any(f"{root}.{layer}" not in modules for layer in lora_layers(tensors)):
        return dict(tensors)
    return {f"{root}.{name}": value for name, value in tensors.items()}


def read_camera_token(folder: Path) -> Tensor:
    """Read the camera token that belongs to a published peft folder; nothing in the file is executed.

    UserError when the file is missing or holds something else.
    """
    path = folder.with_name(folder.name.removesuffix(LORA_SUFFIX) + TOKEN_SUFFIX)
    if not path.is_file():
        raise UserError(f"{path}: the camera token of {folder.name} is missing. Copy that file beside the folder.")
    tensors = read_tensors(path)
    if set(tensors) != {"camera_token"}:
        raise UserError(f"{path}: expected only camera_token, found {', '.join(sorted(tensors)) or 'nothing'}.")
    require_sound(tensors, path)
    return tensors["camera_token"]


def export_published(adapter: Adapter, folder: Path, name: str = "latest") -> list[Path]:
    """Write an adapter in the authors' layout into `folder`, as `name`; returns the files."""
    files = write_peft(adapter, folder / (name + LORA_SUFFIX), root=adapter.model.published_adapter_root)
    if adapter.camera_token is None:
        return files
    token = folder / (name + TOKEN_SUFFIX)
    with atomic_path(token) as part:
        torch.save({"camera_token": adapter.camera_token.detach().float().cpu().clone()}, part)
    return [*files, token]
