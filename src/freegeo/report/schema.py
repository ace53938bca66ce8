"""What the JSON files of a result have to look like where they are read; other fields in them do not matter."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NotRequired, Required, TypedDict

from freegeo.files import read_json

Scores = dict[str, float | None]


class PhotoRecord(TypedDict):
    """A photo as it was when the result was made."""

    file: str
    sha256: str


class Loss(TypedDict):
    """Of the first and the last tenth of the steps."""

    first: float
    last: float


class Trial(TypedDict):
    """A state of the adapter that was judged; its scores are beside these fields."""

    steps: float
    strength: float


class Verdict(TypedDict, total=False):
    """What the guard decided."""

    outcome: Required[str]
    reason: Required[str]
    frozen: Scores | None
    trials: list[Trial] | None
    chosen: int | None


class Refinement(TypedDict, total=False):
    """What refinement made of the prediction."""

    accepted: bool
    reason: str
    lacking: str | None
    probability: float | None
    frozen: Scores | None
    before: Scores | None
    after: Scores | None


class Known(TypedDict):
    """How many cameras were known."""

    poses: int
    intrinsics: int
    given: NotRequired[int]
    """Of a sequence: known poses of all its photos. The next ones are of the same kind, and of this piece."""
    odd: NotRequired[list[str]]
    chunks: NotRequired[int]
    untied: NotRequired[int]
    rotation_deg: NotRequired[float | None]
    position: NotRequired[float | None]


class RecipeFacts(TypedDict):
    """What the advice mentions of a recipe."""

    lr: float
    hold: float


class ChunkRecord(TypedDict):
    """A chunk of a sequence."""

    number: int
    piece: int | None
    first: int
    last: int


class Seam(TypedDict):
    """A seam between two chunks."""

    first: int
    second: int
    kind: str
    used: bool


class Loop(TypedDict):
    """Two frames of one place."""

    first: int
    second: int
    used: bool


class Together(TypedDict):
    """The bundle adjustment of all photos of a piece."""

    accepted: bool


class PieceRecord(TypedDict, total=False):
    """A part of a sequence that was joined."""

    folder: Required[str]
    ranges: list[list[int]]
    """First and last frame of each run of frames that the piece has."""
    together: Together | None
    """What became of the bundle adjustment of all its photos."""


class SequenceRecord(TypedDict):
    """How a long sequence was joined."""

    chunks: list[ChunkRecord]
    pieces: list[PieceRecord]
    seams: list[Seam]
    loops: list[Loop]


class Summary(TypedDict, total=False):
    """``reconstruction.json``."""

    format: int
    images: list[str]
    photo_files: list[PhotoRecord | None] | None
    warnings: list[str] | None
    not_written: dict[str, str] | None
    seconds: dict[str, float] | None
    versions: dict[str, str] | None
    settings: dict[str, Any] | None
    loss: Loss | None
    verdict: Verdict | None
    rejected_adapter: str | None
    refinement: Refinement | None
    known_cameras: Known | None
    recipe: RecipeFacts | None
    sequence: SequenceRecord | None


class AdapterNotes(TypedDict, total=False):
    """``adapter/freegeo.json``, as far as it is shown."""

    format: int
    loss_curve: list[dict[str, float]] | None


DemoScores = dict[str, dict[str, dict[str, float]]]
"""``scores.json`` of a demo: by stage, number of views, and name."""


def read_part(path: Path, schema: Any) -> dict[str, Any]:
    """Return the content of one of these files, empty where it is missing; DamagedError when it is not of the type."""
    return read_json(path, schema) if path.is_file() else {}
