"""What the JSON files of a result have to look like where they are read; other fields in them do not matter."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Required, TypedDict

from msgspec import Meta

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


class Trial(TypedDict, total=False):
    """A state of the adapter that was judged, with its scores as far as they are shown."""

    steps: Required[float]
    strength: Required[float]
    epipolar_px: float | None
    reprojection_px: float | None
    depth_agreement: float | None
    depth_agreement_frozen: float | None
    matches: float | None
    probability: float | None


class Verdict(TypedDict, total=False):
    """What the guard decided."""

    outcome: Required[str]
    reason: Required[str]
    frozen: Scores | None
    trials: list[Trial] | None
    chosen: int | None


class Refinement(TypedDict, total=False):
    """What refinement made of the prediction."""

    accepted: Required[bool]
    reason: Required[str]
    lacking: Literal["matches", "fit", "proof"] | None
    probability: float | None
    frozen: Scores | None
    before: Scores | None
    after: Scores | None


class Measured(TypedDict):
    """What matches measured with known cameras."""

    points: int
    factor: float


class Known(TypedDict, total=False):
    """What known cameras made of the prediction."""

    source: Required[str]
    poses: Required[int]
    intrinsics: Required[int]
    given: int
    """Of a sequence: known poses of all its photos. The next ones are of the same kind, and of this piece."""
    odd: list[str]
    chunks: int
    untied: int
    scale: float | None
    rotation_deg: float | None
    position: float | None
    measured: Measured | None


class ScaleRecord(TypedDict, total=False):
    """What lengths in metres rest on."""

    value: Required[float]
    source: Required[str]
    spread: float | None


class RecipeFacts(TypedDict, total=False):
    """What the advice mentions of a recipe."""

    lr: Required[float]
    hold: Required[float]
    steps: int | None


class ChunkRecord(TypedDict, total=False):
    """A chunk of a sequence."""

    number: Required[int]
    piece: Required[int | None]
    first: Required[int]
    last: Required[int]
    spare: bool
    """Whether surer chunks have its frames."""
    refined: bool | None
    reason: str | None
    """Why it has no result."""


class Seam(TypedDict, total=False):
    """A seam between two chunks."""

    first: Required[int]
    second: Required[int]
    kind: Required[str]
    used: Required[bool]
    frames: Required[int]
    inliers: float | None
    rms: float | None
    scale: float | None
    gap: float | None
    reason: str | None


class Loop(TypedDict, total=False):
    """Two frames of one place."""

    first: Required[int]
    second: Required[int]
    used: Required[bool]
    similarity: float | None
    matches: int | None
    reason: str | None


class Together(TypedDict):
    """The bundle adjustment of all photos of a piece."""

    accepted: bool


class PieceRecord(TypedDict, total=False):
    """A part of a sequence that was joined."""

    folder: Required[str]
    first: Required[int]
    last: Required[int]
    frames: Required[int]
    ranges: list[tuple[int, int]]
    """First and last frame of each run of frames that the piece has."""
    together: Together | None
    """What became of the bundle adjustment of all its photos."""


class SequenceRecord(TypedDict):
    """How a long sequence was joined."""

    frames: int
    chunk: int
    overlap: int
    order: str
    chunks: list[ChunkRecord]
    pieces: Annotated[list[PieceRecord], Meta(min_length=1)]
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
    scale: ScaleRecord | None
    licence_of_weights: str | None
    image_hw: tuple[int, int] | None
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
