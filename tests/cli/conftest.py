"""Runs of the command line inside the test process, on small photos of a generated room."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from PIL import Image

from freegeo.cli.app import main
from freegeo.data.procedural import render, sample_rooms
from freegeo.models.da3_config import EMBEDDED_WEIGHTS

PHOTOS = 4
QUICK = ["--steps", "2", "--sets", "2", "--guard", "off"]


@dataclass(frozen=True)
class Outcome:
    """What a user sees of a command."""

    code: int
    out: str
    err: str

    def sentence(self) -> str:
        """The last line on stderr, which must be the reason of a failure and the only line of it."""
        lines = self.err.strip().splitlines()
        assert lines[-1].startswith("freegeo: "), self.err
        assert "Traceback" not in self.err
        return lines[-1]


@pytest.fixture
def freegeo(capsys) -> Callable[..., Outcome]:
    """The program: arguments in, exit code and output out."""

    def run(*arguments: object) -> Outcome:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        streams = capsys.readouterr()
        return Outcome(code, streams.out, streams.err)

    return run


@pytest.fixture(scope="session")
def photo_folder(tmp_path_factory) -> Path:
    """Four photos of one generated room, 64 x 48."""
    folder = tmp_path_factory.mktemp("photos")
    views = render(sample_rooms([20_000_003], domain="test-id", frames=PHOTOS), 48, 64)
    for k, image in enumerate(views.images[0]):
        pixels = (image.permute(1, 2, 0) * 255).round().byte().numpy()
        Image.fromarray(pixels).save(folder / f"{k}.png")
    return folder


@pytest.fixture(scope="session")
def weights(tmp_path_factory) -> Path:
    """A copy of the embedded weights, which stays the same should somebody train them meanwhile."""
    return Path(shutil.copy(EMBEDDED_WEIGHTS, tmp_path_factory.mktemp("weights") / "tiny.safetensors"))


@pytest.fixture(scope="session")
def tiny(weights) -> list[str]:
    """Options that choose the embedded model."""
    return ["--model", "freegeo-tiny", "--checkpoint", str(weights)]
