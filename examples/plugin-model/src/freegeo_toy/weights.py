"""Draws the toy's weights: `python -m freegeo_toy.weights` writes the file that the package ships."""

import torch
from torch import Tensor

from freegeo.files import write_tensors
from freegeo_toy import ENTRY
from freegeo_toy.model import Toy


def draw(seed: int = 0) -> dict[str, Tensor]:
    """Return half-precision tensors that keep the size of what passes through them."""
    generator = torch.Generator().manual_seed(seed)
    drawn = {}
    for name, value in Toy().state_dict().items():
        noise = torch.randn(value.shape, generator=generator)
        scaled = noise * value[0].numel() ** -0.5 if value.ndim > 1 else noise * 0.1
        drawn[name] = (scaled + 1 if "norm" in name and name.endswith("weight") else scaled).half()
    return drawn


if __name__ == "__main__":
    write_tensors(ENTRY.packaged_weights, draw())
