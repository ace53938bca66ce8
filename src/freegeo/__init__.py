"""freegeo: adapt feed-forward 3D models to one scene at test time, without 3D ground truth.

The names below load on first use, so that `import freegeo` stays light (no torch).
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "load_model": "freegeo.models.catalog",
    "load_photos": "freegeo.data.photos",
    "read_cameras": "freegeo.cameras.reading",
    "adapt": "freegeo.pipeline",
    "reconstruct": "freegeo.pipeline",
    "reconstruct_sequence": "freegeo.sequence_api",
    "refine": "freegeo.refined",
    "load_adapter": "freegeo.pipeline",
    "open_reconstruction": "freegeo.export.reconstruction",
    "evaluate": "freegeo.metrics.scene",
}

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'freegeo' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
