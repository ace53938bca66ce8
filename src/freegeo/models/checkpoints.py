"""Reading checkpoints: find the tensors, translate their names, and refuse anything that does not fit exactly.

A checkpoint is one file, or several parts listed in an index (`*.index.json`). Names may be those of a wrapped model
(DistributedDataParallel, `torch.compile`, a trainer), since names and shapes must match exactly after unwrapping.
"""

from __future__ import annotations

import argparse
import hashlib
import logging
import pickle
import re
import struct
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Generator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, TypeVar

import torch
from torch import Tensor, nn

from freegeo.errors import DamagedError, UserError
from freegeo.files import NAME_MAX, damaged_tensors, fitted, inside, read_json, write_tensors
from freegeo.models.spec import KeyRules

logger = logging.getLogger(__name__)

Model = TypeVar("Model", bound=nn.Module)

PICKLES = (".pt", ".pth", ".bin", ".ckpt")
INDEX = ".index.json"
USUAL_NAMES = ("model.safetensors", f"model.safetensors{INDEX}", "model.pt", "pytorch_model.bin")
WRAPPERS = frozenset({"module", "_orig_mod", "_fsdp_wrapped_module", "_checkpoint_wrapped_module"})
"""Parts of a name that PyTorch's wrappers put into it."""
NESTS = ("model", "state_dict", "model_state_dict", "module", "weights", "params")
"""Where training programs keep the weights in a file with more content; the first of them counts."""

_BLOCK_BYTES = 1 << 16
_BLOCKS = 64
_PART = re.compile(r"-\d+-of-\d+$")
_PICKLE_ERRORS = (
    pickle.UnpicklingError, RuntimeError, EOFError, ValueError, LookupError, AttributeError, TypeError, OSError,
    ArithmeticError, MemoryError, AssertionError, struct.error,
)  # fmt: skip
"""What PyTorch raises for damaged files."""
_DTYPES = {"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16}


class _Index(TypedDict):
    weight_map: dict[str, str]


class Stored(NamedTuple):
    """What a file says about a tensor before it is loaded."""

    shape: tuple[int, ...]
    dtype: torch.dtype | str
    """A type that weights are read from, or the file's name for another one."""


def find_file(path: Path) -> Path:
    """Return the path of a weight file or index itself, or for a folder the one in it; `~` is the user's home."""
    path = path.expanduser()
    if path.is_file():
        return _whole(path)
    if not path.exists():
        raise UserError(f"{path}: no such checkpoint. Give a .safetensors or .pt file, or a folder that holds one.")
    for name in USUAL_NAMES:
        if (path / name).is_file():
            return path / name
    for ending in (".safetensors", INDEX, *PICKLES):
        files = sorted(path.glob(f"*{ending}"))
        whole = [file for file in files if not _PART.search(file.stem)]
        if len(whole) == 1:
            return whole[0]
        if whole:
            raise UserError(f"{path}: expected one checkpoint, found {len(whole)} weight files. Name the file itself.")
    parts = [file for file in path.iterdir() if _PART.search(file.stem)]
    if parts:
        return _whole(min(parts))
    raise UserError(
        f"{path}: expected a checkpoint such as model.safetensors or model.pt, found 0 weight files. Name the file "
        "itself."
    )


def _whole(path: Path) -> Path:
    """Return the index of a checkpoint for one of its parts; other files as they are."""
    if not _PART.search(path.stem):
        return path
    index = path.with_name(_PART.sub("", path.stem) + path.suffix + INDEX)
    if not index.is_file():
        raise UserError(f"{path}: one part of a checkpoint whose index {index.name} is missing. Put that beside it.")
    return index


def parts_of(path: Path) -> dict[Path, list[str] | None]:
    """Return the files of a checkpoint with the names to read from each; None: all in it."""
    if not path.name.endswith(INDEX):
        return {path: None}
    try:
        names = read_json(path, _Index)["weight_map"]
    except DamagedError as error:
        raise UserError(
            f"{path}: not the index of a checkpoint ({error.reason}). Give the weight file itself."
        ) from None
    if not names:
        raise UserError(f"{path}: not the index of a checkpoint (no weight_map). Give the weight file itself.")
    parts: dict[Path, list[str] | None] = {}
    for file in sorted(set(names.values())):
        if Path(file).name != file or fitted(file) != file or not inside(path.parent, file).is_file():
            shown = file if len(file) <= NAME_MAX else f"{file[:80]}..."
            raise UserError(f"{path.parent / shown}: this part of the checkpoint is missing. Download it too.")
        parts[path.parent / file] = [name for name, place in names.items() if place == file]
    return parts


def read_header(path: Path) -> dict[str, Stored]:
    """Return what a safetensors file holds without loading it; UserError when it is damaged or no such file."""
    from safetensors import safe_open

    with _readable(path), safe_open(path, framework="pt") as file:
        found = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        return {name: _stored(part.get_shape(), part.get_dtype()) for name, part in found.items()}


def _stored(shape: list[int], dtype: str) -> Stored:
    return Stored(tuple(shape), _DTYPES.get(dtype, dtype))


@contextmanager
def _readable(path: Path) -> Generator[None]:
    """Turn what the reader of safetensors says about a damaged file into one sentence."""
    _require_weights(path)

    def sentence(error: Exception) -> UserError:
        reason = " ".join(str(error).removeprefix("Error while deserializing header: ").split())
        if "not fully covered" in reason or "header length" in reason:
            return UserError(
                f"{path}: the file is truncated or damaged ({path.stat().st_size:,} bytes do not agree with its "
                "header). Download it again."
            )
        return UserError(
            f"{path}: not a safetensors file, a renamed pickle or damaged ({reason.partition(', expected')[0][:200]}). "
            "Use the official .safetensors download."
        )

    with damaged_tensors(sentence):
        yield


def _require_weights(path: Path) -> None:
    """Refuse text that is left in the place of weights when a download went wrong."""
    with path.open("rb") as file:
        start = file.read(64).lstrip()
    if start.startswith(b"version https://git-lfs"):
        raise UserError(f"{path}: a pointer of Git LFS, not the weights. Run `git lfs pull`, or download the file.")
    if start[:1] == b"<":
        raise UserError(f"{path}: a web page, not weights. Download it again; the site may ask you to log in first.")


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Load a checkpoint: .safetensors, an index of parts, or a .pt file of tensors, in which nothing is executed."""
    tensors: dict[str, Tensor] = {}
    for part, names in parts_of(path).items():
        found = _read_part(part)
        absent = [name for name in names or () if name not in found]
        if absent:
            raise UserError(f"{part}: {len(absent)} tensors of {path.name} are missing (first: {absent[0]}).")
        tensors |= found if names is None else {name: found[name] for name in names}
    return tensors


def stored_tensors(path: Path) -> dict[str, Stored]:
    """Return what a checkpoint holds; of safetensors files only headers are read."""
    stored: dict[str, Stored] = {}
    for part, names in parts_of(path).items():
        if part.suffix == ".safetensors":
            found = read_header(part)
        else:
            found = {name: Stored(tuple(value.shape), value.dtype) for name, value in _read_part(part).items()}
        stored |= found if names is None else {name: found[name] for name in names if name in found}
    return stored


def _read_part(path: Path) -> dict[str, Tensor]:
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        with _readable(path):
            return load_file(path)
    if path.suffix not in PICKLES:
        raise UserError(f"{path}: unknown kind of checkpoint '{path.suffix}'. Use .safetensors or .pt.")
    return _state_dict(read_pickle(path), path)


def read_pickle(path: Path, device: torch.device | str = "cpu") -> Any:
    """Return the tensors and plain values of a file of `torch.save`, on a device, without running code from it.

    UserError when the file is damaged or holds anything else.
    """
    _require_weights(path)
    with path.open("rb") as file:
        in_zip = file.read(4) == b"PK\3\4"
    try:
        # A Namespace of options, which many training programs store, is plain data.
        with torch.serialization.safe_globals([argparse.Namespace]), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about the pickle's protocol
            return torch.load(path, map_location=device, mmap=in_zip, weights_only=True)
    except _PICKLE_ERRORS as error:
        foreign = re.search(r"GLOBAL ([\w.]+)", str(error))
        if foreign:
            raise UserError(
                f"{path}: the file holds more than plain tensors ({foreign[1]}), and freegeo never runs code from a "
                "checkpoint. Use the official .safetensors download, or save the state dict alone."
            ) from None
        raise UserError(
            f"{path}: not a readable checkpoint; it is damaged, truncated, or of another kind. Download it again, or "
            "remove it if a training run of yours left it."
        ) from None


def _state_dict(content: Any, path: Path) -> dict[str, Tensor]:
    """Find the weights in the content of a training checkpoint; other weights beside them are mentioned."""
    while isinstance(content, Mapping) and not _is_state(content):
        nests = [name for name in NESTS if isinstance(content.get(name), Mapping)]
        if not nests:
            break
        others = [name for name, value in content.items() if name != nests[0] and _is_state(value)]
        if others:
            logger.warning(
                "%s: the weights under '%s' are used; the file also holds '%s'.", path, nests[0], "', '".join(others)
            )
        content = content[nests[0]]
    if not _is_state(content):
        raise UserError(f"{path}: not a plain state dict of tensors. Use the official .safetensors download.")
    return dict(content)


def _is_state(value: Any) -> bool:
    return (
        isinstance(value, Mapping)
        and len(value) > 0
        and all(isinstance(name, str) and isinstance(tensor, Tensor) for name, tensor in value.items())
    )


def load_weights(model: nn.Module, path: Path, rules: KeyRules, model_name: str) -> None:
    """Fill a model (built anywhere, also on `meta`) from a file; names and shapes must match exactly.

    Weights take the dtype the model was built with. UserError lists how many names are missing, unexpected or of
    another shape, and the first of each; or names the first tensor with a value that is not finite.
    """
    tensors = read_tensors(path)
    source = match_names(model, {name: tuple(t.shape) for name, t in tensors.items()}, path, rules, model_name)
    wanted = model.state_dict()
    require_sound({source[name]: tensors[source[name]] for name in _floats(wanted)}, path)
    state = {name: tensors[file_name].to(wanted[name].dtype) for name, file_name in source.items()}
    model.load_state_dict(state, assign=True)
    for parameter in model.parameters():
        parameter.requires_grad_(False)


def save_weights(model: nn.Module, path: Path, rules: KeyRules, metadata: Mapping[str, str]) -> None:
    """Write a model's weights as safetensors under the names of its official checkpoint; `load_weights` reads them."""
    state = model.state_dict()
    write_tensors(path, {name: state[ours] for ours, name in rules.file_names(state).items()}, metadata)


def require_sound(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Raise UserError when weights are of a type that needs more than a conversion, or hold NaN or infinity."""
    _require_floats({name: value.dtype for name, value in tensors.items()}, path)
    # Minimum and maximum show any NaN or infinity, in one pass and without memory of the tensor's size.
    damaged = [
        name for name, value in tensors.items() if value.numel() and not torch.stack(value.aminmax()).isfinite().all()
    ]
    if damaged:
        raise UserError(
            f"{path}: {len(damaged)} tensors hold values that are not finite (first: {damaged[0]}); the file is "
            "damaged or its training diverged. Use another file."
        )


def _require_floats(dtypes: Mapping[str, torch.dtype | str], path: Path) -> None:
    others = [name for name, dtype in dtypes.items() if dtype not in _DTYPES.values()]
    if others:
        kind = str(dtypes[others[0]]).removeprefix("torch.")
        raise UserError(
            f"{path}: {len(others)} tensors are stored as {kind} (first: {others[0]}), which needs scales that freegeo "
            "does not read. Use weights in float32, float16 or bfloat16."
        )


def _floats(state: Mapping[str, Tensor]) -> list[str]:
    return [name for name, value in state.items() if value.is_floating_point()]


def match_names(
    model: nn.Module, shapes: Mapping[str, tuple[int, ...]], path: Path, rules: KeyRules, model_name: str
) -> dict[str, str]:
    """Return our name -> file name for every tensor of a model; UserError unless names and shapes match exactly.

    The file of another model that `rules` know of is refused by what it is.
    """
    wanted = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    source = _unwrapped(list(shapes), wanted, path)
    for name, sentence in rules.foreign.items():
        if name in source:
            raise UserError(f"{path}: {sentence}")
    source = {name: file_name for name, file_name in source.items() if not name.startswith(rules.skipped or ("\0",))}
    for alias, stored in rules.aliases.items():
        if stored in source:
            source.setdefault(alias, source[stored])
    require_match(
        wanted,
        {name: shapes[file_name] for name, file_name in source.items()},
        f"{path}: this checkpoint does not fit {model_name}",
        "Check --model and --checkpoint.",
    )
    return source


def _unwrapped(names: list[str], wanted: Collection[str], path: Path) -> dict[str, str]:
    """Return names without what wrappers put into them and without the prefix of most that fit -> name in the file."""
    wrappers = WRAPPERS - {part for name in wanted for part in name.split(".")}
    parts = [[part for part in name.split(".") if part not in wrappers] for name in names]
    prefixes = Counter(
        ".".join([*name[:k], ""]) for name in parts for k in range(len(name)) if ".".join(name[k:]) in wanted
    )
    prefix = max(prefixes, key=lambda text: prefixes[text], default="")
    found: dict[str, str] = {}
    for name, split in zip(names, parts, strict=True):
        ours = ".".join(split).removeprefix(prefix)
        if ours in found:
            raise UserError(f"{path}: holds {ours} twice, as {found[ours]} and as {name}. Save one of the two alone.")
        found[ours] = name
    return found


def require_fit(model: nn.Module, path: Path, rules: KeyRules, model_name: str) -> None:
    """Raise UserError when a checkpoint does not fit a model; of safetensors files only headers are read."""
    stored = stored_tensors(path)
    source = match_names(model, {name: tensor.shape for name, tensor in stored.items()}, path, rules, model_name)
    _require_floats({source[name]: stored[source[name]].dtype for name in _floats(model.state_dict())}, path)


def require_match(
    wanted: Mapping[str, tuple[int, ...]], found: Mapping[str, tuple[int, ...]], what: str, advice: str
) -> None:
    """Raise UserError when two sets of named shapes differ, with counts and the first names between two sentences."""
    missing = [name for name in wanted if name not in found]
    unexpected = [name for name in found if name not in wanted]
    reshaped = [name for name in wanted if name in found and wanted[name] != found[name]]
    if not (missing or unexpected or reshaped):
        return
    parts = [
        f"{len(names)} {kind} (first: {show(names[0])})"
        for kind, names, show in (
            ("missing", missing, str),
            ("unexpected", unexpected, str),
            ("of another shape", reshaped, lambda n: f"{n} is {found[n]}, expected {wanted[n]}"),
        )
        if names
    ]
    raise UserError(f"{what}: {', '.join(parts)}. {advice}")


def fingerprint(path: Path) -> str:
    """Identify a checkpoint by its size and 64 evenly spaced blocks (a full hash of 5 GB would cost seconds)."""
    parts = list(parts_of(path))
    if len(parts) > 1:
        return hashlib.sha256("".join(fingerprint(part) for part in parts).encode()).hexdigest()[:16]
    (path,) = parts
    size = path.stat().st_size
    digest = hashlib.sha256(str(size).encode())
    with path.open("rb") as file:
        for i in range(_BLOCKS):
            file.seek(max(0, size - _BLOCK_BYTES) * i // (_BLOCKS - 1))
            digest.update(file.read(_BLOCK_BYTES))
    return digest.hexdigest()[:16]


def fingerprint_of(model: nn.Module) -> str:
    """Identify the weights that a model has now, wherever they came from: names, shapes, types and every number."""
    digest = hashlib.blake2b(digest_size=8)
    for name, tensor in model.state_dict().items():
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}\n".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def sha256_of_parts(path: Path) -> dict[str, str]:
    """Return the SHA-256 of a checkpoint's files by their names; a file is read again when it has changed."""
    return {part.name: _sha256(part, part.stat().st_mtime_ns) for part in parts_of(path)}


@lru_cache(maxsize=64)
def _sha256(path: Path, changed: int) -> str:
    from freegeo.models.hub import sha256_of

    return sha256_of(path)


def build_on_meta(build: Callable[[], Model]) -> Model:
    """Build a model without memory, for counting or for loading by assignment."""
    with torch.device("meta"):
        return build()
