"""Writing one benchmark's numbers together with the machine and the versions they were measured on."""

import json
import os
import platform
from importlib.metadata import version
from pathlib import Path


def machine() -> dict[str, object]:
    """Describe the processor, and the GPU when there is one."""
    import torch

    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        processor = names[0] if names else processor
    described: dict[str, object] = {"processor": processor, "cores": os.cpu_count(), "system": platform.system()}
    if torch.cuda.is_available():
        described["gpu"] = torch.cuda.get_device_name()
    return described


def write_result(
    path: Path, *, settings: dict, results: dict, packages: tuple[str, ...] = ("torch", "numpy"), show: bool = True
) -> None:
    """Write the JSON record of one run, and print it."""
    record = {
        "settings": settings,
        "results": results,
        "machine": machine(),
        "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(record, indent=1)
    path.write_text(text + "\n", encoding="utf-8")
    if show:
        print(text)
