"""`freegeo doctor`: what is installed, what this machine has, what is broken, and what to do next."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from freegeo import __version__
from freegeo.cli import console
from freegeo.errors import FreeGeoError
from freegeo.host import gigabytes

EXTRAS: Mapping[str, tuple[str, str]] = {
    "colmap": ("pycolmap", "refinement of cameras, recipe evidence, COLMAP projects"),
    "view": ("viser", "freegeo view"),
    "app": ("gradio", "freegeo app"),
    "heif": ("pillow_heif", "HEIC photos"),
    "exr": ("OpenEXR", "depth as EXR files"),
    "rerun": ("rerun", "recordings for rerun"),
    "cluster": ("ray", "freegeo batch --cluster"),
}
"""Extras that give users something -> the module that has to load, and what it is for."""
QUICK, SLOW = ("pycolmap", "pillow_heif", "OpenEXR", "viser"), ("rerun", "ray", "gradio")
"""Modules of extras by how long they take to load."""
CORE = ("numpy", "PIL", "cv2", "av", "scipy")
"""Modules with libraries of their own that freegeo cannot do without, beside torch."""
PATIENCE_S = 5.0
"""How long loading of extras may take; what has not loaded by then is installed and was not tried."""
SETTINGS = ("HF_HOME", "HF_HUB_CACHE", "HF_HUB_OFFLINE", "HF_ENDPOINT")
_SHOWN = 200
_TRY = """
import importlib, json, sys
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
        error = None
    except BaseException as problem:
        error = " ".join(f"{type(problem).__name__}: {problem}".split())
    print(json.dumps([name, error]), flush=True)
"""


@dataclass(frozen=True, kw_only=True)
class Extra:
    """An extra of the package."""

    name: str
    state: Literal["installed", "missing", "broken", "not tried"]
    version: str | None
    about: str
    install: str
    """The command that installs it."""
    error: str | None = None


@dataclass(frozen=True, kw_only=True)
class CachedModel:
    """A model's file on this machine."""

    name: str
    path: str
    bytes: int
    complete: bool


@dataclass(kw_only=True)
class Findings:
    """All that `freegeo doctor` finds; sizes in bytes."""

    freegeo: str = __version__
    python: str = platform.python_version()
    platform: str = field(default_factory=platform.platform)
    torch: str | None = None
    torch_build: str | None = None
    devices: list[dict[str, Any]] = field(default_factory=list)
    cores: int = 1
    memory_free: int = 0
    disk_free: dict[str, int] = field(default_factory=dict)
    extras: list[Extra] = field(default_factory=list)
    models: list[CachedModel] = field(default_factory=list)
    hub: dict[str, str | None] = field(default_factory=dict)
    broken: list[str] = field(default_factory=list)
    next: list[str] = field(default_factory=list)


def doctor(*, as_json: Annotated[bool, Parameter(name="--json", negative="")] = False) -> None:
    """Say what is installed, what this machine has, what is broken and what to do next. Uses no network.

    Exit code 1 when something is broken.

    Parameters
    ----------
    as_json
        Print everything as JSON.
    """
    found = examine()
    if as_json:
        console.say(json.dumps(asdict(found), indent=2))
    else:
        _say(found)
    if found.broken:
        raise FreeGeoError(" ".join(found.broken))


def examine() -> Findings:
    """Look at everything."""
    found = Findings()
    trials = [_Trial((*CORE, *QUICK)), _Trial(SLOW)]
    gpus = _nvidia_gpus()
    _look_at_torch(found, gpus)
    _look_at_machine(found)
    loaded = {name: error for trial in trials for name, error in trial.outcome().items()}
    _look_at_packages(found, loaded)
    _look_at_models(found)
    _advise(found)
    return found


class _Trial:
    """Modules that are loaded in a process of their own, which may hang or crash."""

    def __init__(self, modules: Sequence[str]):
        self.modules = [name for name in modules if _is_there(name)]
        self.started = time.monotonic()
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", _TRY, *self.modules], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            stdin=subprocess.DEVNULL, text=True, encoding="utf-8",
        )  # fmt: skip

    def outcome(self) -> dict[str, str | None]:
        """Return module -> error, None where it loaded; those that were not tried in time are left out."""
        try:
            said, _ = self.process.communicate(timeout=max(0.1, self.started + PATIENCE_S - time.monotonic()))
            crashed = self.process.returncode != 0
        except subprocess.TimeoutExpired:
            self.process.kill()
            said, _ = self.process.communicate()
            crashed = False
        errors = dict(json.loads(line) for line in said.splitlines() if line.startswith("["))
        if crashed and (left := [name for name in self.modules if name not in errors]):
            errors[left[0]] = f"it ends the process that loads it (code {self.process.returncode})"
        return errors


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def _nvidia_gpus() -> list[str]:
    """Return the names of NVIDIA's GPUs as their driver tells them, without torch."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return []
    with suppress(OSError, subprocess.SubprocessError):
        asked = [program, "--query-gpu=name", "--format=csv,noheader"]
        told = subprocess.run(asked, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
        return [line.strip() for line in told.stdout.splitlines() if line.strip()]
    return []


def _look_at_torch(found: Findings, gpus: Sequence[str]) -> None:
    if not _is_there("torch"):
        found.broken.append("torch is missing: pip install torch.")
        return
    try:
        torch = import_module("torch")
    except Exception as error:
        found.broken.append(
            f"torch cannot be loaded ({_reason(error)}): reinstall it, pip install --force-reinstall torch."
        )
        return
    found.torch = str(torch.__version__)
    cuda, hip = torch.version.cuda, getattr(torch.version, "hip", None)
    found.torch_build = f"CUDA {cuda}" if cuda else f"ROCm {hip}" if hip else "CPU only"
    if torch.cuda.is_available():
        for number in range(torch.cuda.device_count()):
            free, total = torch.cuda.mem_get_info(number)
            about = torch.cuda.get_device_name(number)
            found.devices.append({"name": f"cuda:{number}", "about": about, "memory": total, "free": free})
    elif gpus and cuda:
        found.broken.append(
            f"torch {found.torch} is built for CUDA {cuda} and cannot use the GPU ({gpus[0]}): update NVIDIA's driver, "
            "or install a build for an older CUDA (https://pytorch.org/get-started/locally/)."
        )
    elif gpus:
        found.next.append(
            f"There is a GPU ({gpus[0]}), and torch {found.torch} is a build for the CPU only, which cannot use it: "
            "install a CUDA build (https://pytorch.org/get-started/locally/)."
        )
    if torch.backends.mps.is_available():
        found.devices.append({"name": "mps", "about": "Apple GPU, which shares the main memory"})


def _look_at_machine(found: Findings) -> None:
    from freegeo.host import host_available

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    found.cores, found.memory_free = cores or 1, host_available()
    cache = _cache(found)
    for place in filter(None, dict.fromkeys((Path.cwd(), cache))):
        existing = next(folder for folder in (place, *place.parents) if folder.exists())
        found.disk_free[str(place)] = shutil.disk_usage(existing).free
        if place == cache and not os.access(existing, os.W_OK):
            found.broken.append(
                f"{existing} cannot be written to, where models are kept: set HF_HOME to another folder."
            )
    found.hub = {"cache": None if cache is None else str(cache), **{name: _setting(name) for name in SETTINGS}}


def _setting(name: str) -> str | None:
    from freegeo.models.hub import without_password

    value = os.environ.get(name)
    return None if value is None else without_password(value)


def _cache(found: Findings) -> Path | None:
    """Return where models are kept; None where the library that knows does not load."""
    from freegeo.models.hub import cache_folder

    try:
        return cache_folder()
    except Exception as error:
        if _version("huggingface_hub"):
            found.broken.append(
                f"huggingface_hub, which freegeo needs, cannot be loaded ({_reason(error)}): reinstall it."
            )
        return None


def _look_at_packages(found: Findings, loaded: Mapping[str, str | None]) -> None:
    """Note which required packages are missing, old or broken, and the state of every extra."""
    required, wanted = _requirements()
    for text in filter(None, map(_lacking, required)):
        found.broken.append(text)
    found.broken += [
        f"{name}, which freegeo needs, cannot be loaded ({error[:_SHOWN]}): reinstall it."
        for name in CORE
        if (error := loaded.get(name))
    ]
    for name, (module, about) in EXTRAS.items():
        install, error = f"pip install 'freegeo[{name}]'", loaded.get(module)
        packages = wanted.get(name, ())
        old = next(filter(None, map(_lacking, packages)), None) if _is_there(module) else None
        version = _version(packages[0].name) if packages else None
        if not _is_there(module):
            found.extras.append(Extra(name=name, state="missing", version=None, about=about, install=install))
            continue
        if trouble := error or old:
            found.broken.append(
                f"Extra {name}: {module} does not work ({trouble[:_SHOWN].rstrip('.')}). Reinstall it: {install}."
            )
        state = "broken" if trouble else "installed" if module in loaded else "not tried"
        found.extras.append(Extra(name=name, state=state, version=version, about=about, install=install, error=trouble))


def _requirements() -> tuple[list[Any], dict[str, list[Any]]]:
    """Return what freegeo needs, and what each extra needs, as its metadata say; nothing for bare source files."""
    try:
        from packaging.requirements import Requirement

        found = [Requirement(text) for text in metadata.requires("freegeo") or []]
    except (ImportError, metadata.PackageNotFoundError):
        return [], {}
    always = [one for one in found if one.marker is None or one.marker.evaluate({"extra": ""})]
    extras = {
        name: [one for one in found if one not in always and one.marker and one.marker.evaluate({"extra": name})]
        for name in EXTRAS
    }
    return always, extras


def _lacking(requirement: Any) -> str | None:
    """Say that a package is missing or has a version that does not do; None where it is fine."""
    version = _version(requirement.name)
    if requirement.name == "torch" and version is None:
        return None  # said before
    if version is None:
        return f"{requirement.name} is missing: pip install '{requirement.name}{requirement.specifier}'."
    if requirement.specifier.contains(version, prereleases=True):
        return None
    wanted = f"{requirement.name}{requirement.specifier}"
    return f"{requirement.name} {version} is installed, and {wanted} is needed: pip install '{wanted}'."


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _look_at_models(found: Findings) -> None:
    from freegeo.models import catalog
    from freegeo.models.hub import cached_file

    if found.torch is None or found.hub["cache"] is None:
        return  # plug-ins and the check of a file's length need both
    for name in catalog.names():
        try:
            item = catalog.entry(name)
        except Exception as error:
            found.broken.append(str(catalog.broken(name, error)))
            continue
        if item.packaged_weights is not None:
            if not item.packaged_weights.is_file():
                found.broken.append(
                    f"{item.packaged_weights}: the weights of {name} are missing. Reinstall the package."
                )
        elif item.hub_id is not None and (file := cached_file(item)) is not None:
            path, size, complete = file
            found.models.append(CachedModel(name=name, path=str(path), bytes=size, complete=complete))


def _advise(found: Findings) -> None:
    """Add sentences about what to install or download next."""
    from freegeo.models import catalog

    states = {extra.name: extra for extra in found.extras}
    if found.torch and not found.devices and not found.next and not found.broken:
        found.next.append("No GPU: models run on the CPU, where da3-small is the smallest of the published ones.")
    if states["colmap"].state == "missing":
        found.next.append(f"Without pycolmap, cameras are not refined after adapting: {states['colmap'].install}.")
    for model in found.models:
        if not model.complete:
            found.next.append(f"{model.name} is not complete: `freegeo models download {model.name}` completes it.")
    if found.torch and found.hub["cache"] and not any(model.complete for model in found.models):
        item = catalog.entry(catalog.DEFAULT_MODEL)
        size = gigabytes(item.download_bytes)
        found.next.append(
            f"No published model is on this machine: `freegeo models download {item.name}` fetches the default one "
            f"({size}); {catalog.EMBEDDED_MODEL}, which is in the package, is for demonstrations and tests only."
        )
        if found.hub["HF_HUB_OFFLINE"]:
            found.next.append("HF_HUB_OFFLINE is set, which forbids downloads: unset it for that.")
    missing = [extra.name for extra in found.extras if extra.state == "missing" and extra.name != "colmap"]
    if missing:
        found.next.append(f"Not installed, and only needed for what the table says: {', '.join(missing)}.")


def _say(found: Findings) -> None:
    """Print the findings."""
    console.say(f"freegeo {found.freegeo}, Python {found.python}, {found.platform}")
    console.say(f"torch {found.torch} ({found.torch_build})" if found.torch else "torch: none that works")
    for device in found.devices:
        memory = (
            f", {gigabytes(device['memory'])}, {gigabytes(device['free'])} of them free" if "memory" in device else ""
        )
        console.say(f"{device['name']}: {device['about']}{memory}")
    console.say(f"cpu: {found.cores} cores, {gigabytes(found.memory_free)} of memory free")
    for place, free in found.disk_free.items():
        console.say(f"disk: {gigabytes(free)} free for {place}")
    rows = [(extra.name, extra.version or "", extra.state, extra.install, extra.about) for extra in found.extras]
    console.say("\n" + console.table(("extra", "version", "state", "installed by", "for"), rows, prose=100))
    if found.models:
        rows = [
            (one.name, gigabytes(one.bytes), "complete" if one.complete else "incomplete", one.path)
            for one in found.models
        ]
        console.say("\n" + _lines("models on this machine", ("  ".join(row) for row in rows)))
    elif found.torch:
        console.say("\nmodels on this machine: none but freegeo-tiny, which is in the package")
    settings = ", ".join(f"{name}={value}" for name, value in found.hub.items() if value and name != "cache")
    console.say(f"model hub: {settings or 'default settings'}; not asked whether it can be reached")
    if found.broken:
        console.say("\n" + _lines("Broken", found.broken))
    if found.next:
        console.say("\n" + _lines("What to do next", found.next))


def _lines(title: str, lines: Iterable[str]) -> str:
    return "\n".join([f"{title}:", *(f"  {line}" for line in lines)])


def _reason(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:_SHOWN]
