"""A plug-in for freegeo: the entry point `toy` of the group `freegeo.models` names ENTRY."""

from pathlib import Path

from freegeo.models.spec import ModelEntry

LICENCE = "Apache-2.0"


def build():
    """Build the model without weights; importing it here keeps `freegeo --help` free of torch."""
    from freegeo_toy.model import Toy

    return Toy()


ENTRY = ModelEntry(
    name="toy",
    about="plug-in example with random weights: shows the contract, reconstructs nothing",
    licence=LICENCE,
    parameters=27_713,
    build=build,
    packaged_weights=Path(__file__).with_name("toy.safetensors"),
)
