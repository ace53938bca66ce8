"""What `freegeo run` and `reconstruct` do with more photos than are predicted at once (docs/sequences.md).

Each chunk is a job with a folder of its own, and one adapter is trained for all. A stopped run continues at the first
chunk that is not finished.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from itertools import combinations, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from freegeo import files
from freegeo.adaptation.adapted import Adapted
from freegeo.adaptation.views import chunk_windows
from freegeo.data.photos import some_of
from freegeo.data.video import VideoFrame
from freegeo.errors import FreeGeoError, LostFolderError, UserError
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import combined, load_matches, stored_matches
from freegeo.evidence.refinement import Refinement, depth_factors, refine
from freegeo.export.base import KEPT_NAME, TRACKS_NAME
from freegeo.export.measured import save_tracks
from freegeo.export.pixels import masks_for_model
from freegeo.export.reconstruction import Reconstruction, Scale, save_streamed
from freegeo.files import write_json
from freegeo.guarded import Evidence
from freegeo.job import (
    ADAPTATION,
    DEPTH_SIZE,
    FILES_STAGE,
    FILTERS,
    FORMATS,
    FROZEN_FOLDER,
    MATCHES_NAME,
    PLACING,
    PREDICTION,
    PREDICTION_NAME,
    REFINEMENT,
    SUMMARY_NAME,
    Adaptation,
    Computed,
    Hooks,
    Job,
    write_files,
)
from freegeo.metres import FEWEST_POSITIONS, Gps, ScaleSource, scale_to_metres
from freegeo.models.priors import usable
from freegeo.pipeline import capital, judge_by_photos
from freegeo.posed import doubt_focal_length, told_in_chunks, with_one_camera, with_poses
from freegeo.report.page import write_report
from freegeo.run_folder import Part
from freegeo.sequence.alignment import Seam
from freegeo.sequence.assembly import CONTRADICTED, Assembly, Seams, assemble, broken, seams_between
from freegeo.sequence.chunks import Chunk, OrderRule, bridge, common_rows, plan_chunks, runs
from freegeo.sequence.cuts import Jumps, find_cuts
from freegeo.sequence.join import Joined, Member
from freegeo.sequence.loops import Loop, agrees, loop_candidates, loop_frames, verified
from freegeo.sequence.measured import measured_seam
from freegeo.sequence.order import descriptors, in_order, new_pictures, similarity_order

if TYPE_CHECKING:
    from freegeo.adaptation.adapter import Adapter
    from freegeo.adaptation.samples import SceneImages
    from freegeo.cameras.known import KnownCameras
    from freegeo.evidence.matches import Matches
    from freegeo.models.api import ReconstructionModel
    from freegeo.types import ImageBatch, PhotoLike, Priors

logger = logging.getLogger(__name__)

Made = TypeVar("Made")
CHUNKS_FOLDER = "chunks"
PIECES_FOLDER = "pieces"
DESCRIPTORS_NAME = f"{CHUNKS_FOLDER}/descriptors.npz"
JOINING = Part("joining", (PREDICTION_NAME, KEPT_NAME, f"{PIECES_FOLDER}/"), free=True)
SEQUENCE_PARTS = (
    ADAPTATION, replace(PREDICTION, files=(f"{CHUNKS_FOLDER}/",)), PLACING, REFINEMENT, JOINING, FILTERS, FORMATS,
    DEPTH_SIZE,
)  # fmt: skip
"""Parts of the settings of a job with chunks: as `freegeo.job.PARTS`, and how chunks are put together."""
LOOP_APART, FEWEST_APART = 2, 6
"""Frames of a loop are at least so many chunks, and so many frames, apart."""
_READ_AT_ONCE = 16
_NOT_NEEDED = "it fits to no other chunk, and these have all of its frames."
_SPARE = "no matches prove its cameras, and the chunks beside it, of which they do, have all of its frames."
_AT_ONE_END = "The prediction of the frames around both ends does not fit to the chunks at both of them."
_KNOWN_MEDIANS = ("scale", "spread", "rotation_deg", "position", "focal")
"""What is said of known cameras as the median over chunks."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How a sequence is cut into chunks and put together."""

    size: int
    """Frames of a chunk."""
    overlap: int
    """Frames that two neighbouring chunks share."""
    order: OrderRule = "auto"
    loops: bool = True
    """Whether places that the sequence comes back to are looked for."""


@dataclass
class Pace:
    """How long chunks take, to say how much time those that are left need."""

    count: int
    seconds: list[float] = field(default_factory=list)
    """Of each chunk for which something was computed; what a stopped run had finished counts for nothing."""
    is_computed: bool = False
    """Whether something is computed for the present chunk."""

    @contextmanager
    def measured(self) -> Generator[None]:
        """Measure a chunk."""
        self.is_computed, started = False, time.monotonic()
        yield
        if self.is_computed:
            self.seconds.append(time.monotonic() - started)

    def left(self, number: int) -> str:
        """Say how long chunk `number` and those after it take, by the median of those measured; empty before any."""
        if not self.seconds:
            return ""
        seconds = float(np.median(self.seconds)) * (self.count - number)
        return f", last one done in about {f'{seconds:.0f} s' if seconds < 120 else f'{seconds / 60:.0f} min'}"


@dataclass(kw_only=True)
class SequenceJob(Job):
    """The inputs and settings that turn many photos into an output folder; `batch` is read when it is needed."""

    plan: Plan
    failed: dict[int, str] = field(default_factory=dict)
    """Chunk -> why there is no prediction of it."""
    usable: dict[int, Chunk] = field(default_factory=dict)
    """The chunks that the adapter is trained and judged on, by number: those with a frozen prediction."""
    uses_adapter: bool = False
    """Whether the result is that of the adapter, trained or given."""
    order: Literal["given", "similar"] = "given"
    count: int = 0
    """Chunks of the sequence."""
    spare: set[int] = field(default_factory=set)
    """Chunks that are left out because others, which are surer, have their frames."""
    _measured: dict[tuple[str, str], Seam | None] = field(default_factory=dict)
    matched: list[str] = field(default_factory=list)
    """Folders of the chunks, loops and bridges that have a part in the result."""
    world: int | None = None
    """Number of the piece that poses of some photos place in their world."""
    odd: list[int] = field(default_factory=list)
    """Frames whose known poses contradict the others and are not used."""

    def run(self) -> dict[str, Any]:
        """Write everything and return the content of reconstruction.json."""
        self._put_in_order()
        chunks = self._chunks()
        self.count = len(chunks)
        adaptation = self._adapted(chunks)
        self.uses_adapter = self.adapter is not None or adaptation.used
        self._attempt_all(chunks, ChunkJob.make)
        if len(self.failed) == len(chunks):
            raise FreeGeoError(f"no chunk could be predicted: {capital(next(iter(self.failed.values())))}")
        loops, tied = self._loops() if self.plan.loops and not self._is_placed else ([], [])
        numbers = [number for number in range(len(chunks)) if number not in self.failed]
        self.spare = self._spare(chunks, numbers)
        numbers = [number for number in numbers if number not in self.spare]
        parts = [*(chunks[number] for number in numbers), *tied]
        names = [*map(_chunk_name, numbers), *map(_tie_name, tied)]
        with self._timed("seams between chunks", JOINING):
            seams = self._seams(parts, names)
        if not self._is_placed:
            bridges = self._bridges(parts, seams)
            parts, names = [*parts, *bridges], [*names, *map(_tie_name, bridges)]
        with self._timed("places of chunks", JOINING):
            found = assemble(
                parts, self._seams(parts, names, seams), self._reader(names), fixed_scale=self.spec.metric,
                placed=self._is_placed, poses=self._partly_known.poses if self._partly_known else None,
            )  # fmt: skip
        self._doubt_ties(found)
        load = [partial(self._reader(names), k) for k in range(len(names))]
        pieces = [[Member(chunk=parts[k], sim3=found.sim3[k], load=load[k]) for k in piece] for piece in found.pieces]
        held = self._held(found, loops, parts, len(numbers))
        left_out = {_tie_name(one) for one, loop in zip(tied, _tying(held, loops), strict=True) if loop.reason}
        self.matched = [*(name for name in names if name not in left_out), *map(_chunk_name, sorted(self.spare))]
        loops = held
        told = self._told_of(chunks, numbers, found, loops)
        return self._write(list(zip(pieces, found.frames, strict=True)), told, adaptation)

    # -- before the chunks

    def _put_in_order(self) -> None:
        """Bring photos that are no sequence into one by what they show; the order is noted down."""
        assert self.photos is not None
        if "order" not in self._noted("prediction"):
            by_sight = self.plan.order == "similar" or (
                self.plan.order == "auto"
                and not all(isinstance(photo, VideoFrame) for photo in self.photos)
                and not in_order(self.descriptors)
            )
            order = similarity_order(self.descriptors) if by_sight else None
            self.folder.note("prediction", {**self._noted("prediction"), "order": order})
        order = self._noted("prediction")["order"]
        if order is None:
            return
        self.descriptors = self.descriptors[order]
        logger.info("photos are put in an order in which neighbours look alike (--order given keeps theirs)")
        self.order = "similar"
        self.batch = self.batch.select(order)
        self.photos = [self.photos[i] for i in order]
        self.known = None if self.known is None else self.known.select(order)
        self.priors = None if self.priors is None else self.priors.select(order)
        self.masks = None if self.masks is None else [self.masks[i] for i in order]
        self.scale = self.scale.select(order) if isinstance(self.scale, Gps) else self.scale

    def _chunks(self) -> list[Chunk]:
        """Cut the sequence into chunks, none of which reaches over a place where the photos jump."""
        assert self.photos is not None
        if "jumps" not in self._noted("prediction"):
            jumps = asdict(find_cuts(self.descriptors, self.photos))
            self.folder.note("prediction", {**self._noted("prediction"), "jumps": jumps})
        jumps = Jumps(**self._noted("prediction")["jumps"])
        ends = [*jumps.cuts, len(self.batch)]
        chunks = []
        for start, end in zip([0, *ends[:-1]], ends, strict=True):
            size = min(self.plan.size, end - start)
            alone = size == 1
            own = [Chunk(frames=(0,))] if alone else plan_chunks(end - start, size, min(self.plan.overlap, size - 1))
            chunks += [replace(chunk, frames=tuple(start + frame for frame in chunk.frames)) for chunk in own]
        self._doubt_photos(jumps.doubtful)
        if jumps.cuts:
            self._doubt_scale([range(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)])
        for start in jumps.cuts:
            one, two = (self.photos[i].name for i in (start - 1, start))
            self._warn(
                f"Nothing that {one} shows is in {two}, nor in the photos around them: the sequence is cut there. "
                "Photos of what lies between would join both parts."
            )
        return chunks

    def _doubt_scale(self, parts: Sequence[range]) -> None:
        """Say, before anything is predicted, that no part between cuts shows what --scale names; refuse it if certain.

        A loop may join parts.
        """
        if self.scale is None or any(self._scale_of(part) is not None for part in parts):
            return
        sentence = (
            f"--scale says nothing of any of the {len(parts)} parts that the sequence is cut into: it takes both "
            f"places of a distance, or {FEWEST_POSITIONS} GPS positions, in one of them."
        )
        if not self.plan.loops:
            raise UserError(f"{sentence} Measure a distance in one of them, or leave --scale out.")
        logger.info("%s Unless a loop joins parts, lengths will be up to scale.", sentence)

    def _scale_of(self, frames: Sequence[int]) -> ScaleSource | None:
        """Return what --scale says of some frames, None where that is too little."""
        if isinstance(self.scale, Gps):
            positions = self.scale.select(frames)
            return positions if len(positions.views) >= FEWEST_POSITIONS else None
        assert self.photos is not None and self.scale is not None
        distances = self.scale.among([self.photos[i].name for i in frames])
        return distances if distances.measured else None

    def _doubt_photos(self, doubtful: Sequence[int]) -> None:
        """Name photos that may not belong to the others, and those of a camera that stands still."""
        assert self.photos is not None
        if doubtful:
            names = some_of([self.photos[i].name for i in doubtful])
            self._warn(
                f"No match leads from the photos before and after to {names}: where the model puts what is there "
                "cannot be checked. Look whether it belongs to the same scene."
            )
        still = [
            run
            for run in runs(np.flatnonzero(~new_pictures(self.descriptors)).tolist())
            if len(run) >= self.plan.overlap
        ]
        if still:
            told = [f"{self.photos[run[0] - 1].name} to {self.photos[run[-1]].name}" for run in still]
            self._warn(
                f"The photos {some_of(told)} are the same picture, so many that chunks may see nothing else: without "
                "motion, depth and the way to the next photos are a guess. Leave all but a few of them out."
            )

    @cached_property
    def descriptors(self) -> np.ndarray:
        """What each frame shows, (N, C) of unit length; in the file in the order given."""
        file = self.folder / DESCRIPTORS_NAME
        if file.is_file():
            return files.read_npz(file, {"descriptors": ("f", (len(self.batch), -1))})["descriptors"]
        count = len(self.batch)
        with self._timed("what each photo shows"):
            parts = (
                self.batch.select(range(start, min(start + _READ_AT_ONCE, count))).read().images
                for start in range(0, count, _READ_AT_ONCE)
            )
            found = descriptors(self.model, parts, self.compute)
            files.write_npz(file, {"descriptors": found})
        return found

    def _adapted(self, chunks: Sequence[Chunk]) -> Adaptation:
        """Predict all chunks with the frozen model, and train one adapter for all; without a recipe, nothing."""
        if self.recipe is None:
            return Adaptation()
        self._attempt_all(chunks, ChunkJob.frozen)
        self.usable = {number: chunk for number, chunk in enumerate(chunks) if number not in self.failed}
        if not self.usable:
            return Adaptation()
        rejected, verdict = self._trained(self.recipe, None)
        used = self._may_use(rejected, verdict)
        if rejected is not None:
            self._warn(f"{capital(rejected)} The result is that of the frozen model.")
        if not used:
            # What is predicted from here on is the frozen model's, also when this process trained the adapter.
            self.release()
        return Adaptation(used=used, rejected=rejected, verdict=verdict)

    def _scene_images(self) -> SceneImages:
        windows = chunk_windows([chunk.frames for chunk in self.usable.values()])
        return replace(super()._scene_images(), windows=windows)

    def _judge(self, result: Adapted, frozen: Reconstruction | None, judging: list[Matches] | None) -> None:
        """Let the guard judge a finished adapter once, by all chunks."""
        assert self.photos is not None
        evidence = []
        for number, chunk in self.usable.items():
            own, place = list(chunk.frames), self.folder / CHUNKS_FOLDER / _chunk_name(number)
            evidence.append(
                Evidence(
                    photos=[self.photos[i] for i in own], batch=self.batch.select(own).read,
                    frozen=partial(Reconstruction.load, place / FROZEN_FOLDER),
                    priors=self._priors_of(own), store=place / MATCHES_NAME,
                    name=f"chunk {number}", frames=chunk.frames,
                )
            )  # fmt: skip
        judge_by_photos(
            self.model, result, evidence, compute=self.compute, guard=self.guard, reference=self.reference,
            pose_from=self.pose_from,
        )  # fmt: skip

    # -- chunks

    def _job(self, chunk: Chunk, number: int | None = None, pace: Pace | None = None) -> ChunkJob:
        """Return the job of a chunk; a tie has no number, and no `pace`."""
        assert self.photos is not None
        frames = list(chunk.frames)
        name = _tie_name(chunk) if number is None else _chunk_name(number)
        label = (
            f"chunk {number} (frames {chunk}), {number + 1} of {pace.count}{pace.left(number)}"
            if number is not None and pace is not None
            else f"{chunk.tie} of frames {chunk}"
        )

        def stage(name: str) -> None:
            if pace is not None:
                pace.is_computed = True
            self.hooks.stage(f"{label}: {name}")

        values = {f.name: getattr(self, f.name) for f in fields(Job)}
        values |= {
            "batch": self.batch.select(frames), "photos": [self.photos[i] for i in frames],
            "folder": self.folder.sub(f"{CHUNKS_FOLDER}/{name}"),
            "known": self._known_of(frames),
            "priors": self._priors_of(frames), "masks": None, "scale": None,
            "hooks": Hooks(stage=stage),
        }  # fmt: skip
        return ChunkJob(**values, whole=self, is_tie=chunk.tie is not None)

    def _priors_of(self, frames: Sequence[int]) -> Priors | None:
        """Return what the model is told of some frames: what it can take of these, whatever is known of others."""
        return None if self.priors is None else usable(self.priors.select(frames), self.spec)[0]

    def _known_of(self, frames: Sequence[int]) -> KnownCameras | None:
        """Return what the result of a chunk has of known cameras; poses of some photos place chunks as they are."""
        if self.known is None:
            return None
        known = self.known.select(list(frames))
        known = known if self._partly_known is None else known.without_poses(range(len(frames)))
        return known if (known.has_pose | known.has_K).any() else None

    def said_of_known(self) -> str | None:
        """Return what is said of known cameras that the model is told, or not told; None without any."""
        return told_in_chunks(self.known, self.batch, self.spec)[1]

    def _attempt_all(self, chunks: Sequence[Chunk], work: Callable[[ChunkJob], object]) -> None:
        """Do something with each chunk; go on without one, and say so, when there is no usable prediction of it."""
        pace = Pace(len(chunks))
        for number, chunk in enumerate(chunks):
            if number in self.failed:
                continue
            with pace.measured():
                _, reason = _tried(work, self._job(chunk, number, pace))
            if reason is not None:
                self.failed[number] = reason
                self._warn(f"Chunk {number} (frames {chunk}) is left out: {reason}")

    def _loops(self) -> tuple[list[Loop], list[Chunk]]:
        """Look for places that the sequence comes back to: what was found, and a chunk for each one that holds."""
        assert self.photos is not None
        with self._timed("places seen twice", JOINING):
            candidates = loop_candidates(self.descriptors, apart=max(FEWEST_APART, LOOP_APART * self.plan.size))
            loops = verified(candidates, self.photos, self.descriptors, match=self._loop_matches)
        tied = []
        for number, loop in enumerate(loops):
            if loop.reason is None:
                frames = loop_frames(loop.first, loop.second, len(self.batch), self.plan.size)
                chunk = Chunk(frames=frames, tie="loop")
                reason = self._refuted(chunk, loop)
                if reason is None:
                    tied.append(chunk)
                else:
                    loops[number] = replace(loop, reason=reason)
        return loops, tied

    def _held(self, found: Assembly, loops: list[Loop], parts: Sequence[Chunk], first: int) -> list[Loop]:
        """Return the loops, with the reason where one has no part in the places of chunks.

        `first` is the place among `parts` of the chunk of the first loop that held until now; the others follow.
        """
        held, number = [], first
        for loop in loops:
            if loop.reason is None:
                held.append(replace(loop, reason=_not_closed(found, loop, parts, number)))
                number += 1
            else:
                held.append(loop)
        contradicted = sum(loop.reason == CONTRADICTED for loop in held)
        if contradicted:
            self._warn(
                "Places that the photos come back to, as matches say, contradict each other or the way between them: "
                f"places that look alike deceive matches. {contradicted} of {number - first} loops are left out: all "
                "in the part of the sequence where that is so."
            )
        return held

    def _refuted(self, chunk: Chunk, loop: Loop) -> str | None:
        """Predict the frames around both ends of a loop together; returns why that cannot be used."""
        assert self.photos is not None
        made, reason = _tried(ChunkJob.make, self._job(chunk))
        if made is None:
            return reason
        matches = self._loop_matches(loop.frames)
        return agrees(Candidate.of(made.result, str(self.compute.device)), chunk.frames, loop, matches).reason

    def _loop_matches(self, frames: Sequence[int]) -> Matches:
        """Match the photos of both ends of a loop, or read their matches, which are kept for a run that continues."""
        assert self.photos is not None
        name = "-".join(f"{frame:06d}" for frame in frames)
        return stored_matches(
            self.folder / CHUNKS_FOLDER / f"loop-{name}.npz", [self.photos[frame] for frame in frames]
        )

    def _bridges(self, parts: Sequence[Chunk], seams: Seams) -> list[Chunk]:
        """Predict the frames around each seam that does not hold together, which may tie its chunks."""
        found = []
        for a, b in broken(parts, seams):
            tie = bridge(parts[a], parts[b], self.plan.size)
            _, reason = _tried(ChunkJob.make, self._job(tie))
            if reason is None:
                found.append(tie)
            else:
                logger.info("no bridge over frames %s: %s", tie, reason)
        return found

    def _spare(self, chunks: Sequence[Chunk], numbers: Sequence[int]) -> set[int]:
        """Return the chunks that matches do not prove, and whose frames are in chunks beside them that matches join."""
        sure = [number for number in numbers if self._is_proven(_chunk_name(number))]
        return {
            number
            for a, b in pairwise(sure)
            for number in range(a + 1, b)
            if number in numbers
            and {*chunks[number].frames} <= {*chunks[a].frames, *chunks[b].frames}
            and self._measured_seam(_chunk_name(a), _chunk_name(b), range(a, b + 1)) is not None
        }

    def _is_proven(self, name: str) -> bool:
        """Whether the cameras of a chunk, loop or bridge were brought to matches that prove them."""
        refined = self.folder.notes.get("refinement") or {}
        return bool(refined.get(f"{CHUNKS_FOLDER}/{name}", {}).get("accepted"))

    def _measured_seam(self, first: str, second: str, between: Sequence[int] = ()) -> Seam | None:
        """Return the seam by points that matches of two chunks, and of those between them, measure in both."""
        if (first, second) not in self._measured:
            names = dict.fromkeys((first, second, *map(_chunk_name, between)))
            parts = [load_matches(self.folder / CHUNKS_FOLDER / name / MATCHES_NAME) for name in names]
            one, two = (Reconstruction.load(self.folder / CHUNKS_FOLDER / name) for name in (first, second))
            self._measured[first, second] = (
                None
                if parts[0] is None or parts[1] is None
                else measured_seam(
                    Candidate.of(one), Candidate.of(two), (one.names, two.names), [part for part in parts if part],
                    fixed_scale=self.spec.metric,
                )
            )  # fmt: skip
        return self._measured[first, second]

    def _seams(self, parts: Sequence[Chunk], names: Sequence[str], known: Seams | None = None) -> Seams:
        sure, measured = [k for k, name in enumerate(names) if self._is_proven(name)], {}
        for a, b in combinations(sure, 2):
            if common_rows(parts[a], parts[b]) or (names[a], names[b]) in self._measured:
                seam = self._measured_seam(names[a], names[b])
                if seam is not None:
                    measured[a, b] = seam
        return seams_between(parts, self._reader(names), fixed_scale=self.spec.metric, measured=measured, known=known)

    def _reader(self, names: Sequence[str]) -> Callable[[int], Reconstruction]:
        """Return what reads the prediction of a chunk by its number among the names."""
        return lambda number: Reconstruction.load(self.folder / CHUNKS_FOLDER / names[number])

    @property
    def _is_placed(self) -> bool:
        """Whether all chunks are in the frame of known cameras."""
        return self.known is not None and bool(self.known.has_pose.all())

    @property
    def _partly_known(self) -> KnownCameras | None:
        """Known cameras that tie chunks to their world, since the poses of some photos are known; None without."""
        return self.known if self.known is not None and self.known.has_pose.any() and not self._is_placed else None

    def _doubt_ties(self, found: Assembly) -> None:
        """Note which piece is in the world of known cameras, and say which poses are not used."""
        self.world, self.odd, known = found.world, found.odd, self._partly_known
        if known is None:
            return
        if found.odd:
            self._warn(
                f"{known.source}: the poses of {len(found.odd)} of {int(known.has_pose.sum())} photos contradict the "
                f"others and what the model sees, and are not used: {some_of([known.names[i] for i in found.odd])}. "
                "Correct them if they are wrong; if they are right, the result is wrong around these photos."
            )
        if found.world is None:
            self._warn(
                f"{known.source}: no part of the sequence that could be joined has photos with known poses in two "
                "places, so that its position and scale are the model's. Give poses of more photos."
            )
        elif found.world > 0:
            self._warn(
                f"{known.source}: the piece of the result has no photos with known poses in two places: its position "
                f"and scale are the model's. {_piece_folder(found.world)} has those of the known cameras."
            )

    # -- the result

    def _told_of(
        self, chunks: Sequence[Chunk], numbers: Sequence[int], found: Assembly, loops: Sequence[Loop]
    ) -> dict[str, Any]:
        """Return what reconstruction.json says of the sequence."""
        piece_of = {numbers[k]: number for number, piece in enumerate(found.pieces) for k in piece}
        # Chunks that are left out have no seams, and those that tie others are numbered after all others.
        number_of = [*numbers, *range(len(chunks), len(chunks) + len(found.sim3) - len(numbers))]
        refined = self.folder.notes.get("refinement") or {}
        return {
            "frames": len(self.batch), "order": self.order, "chunk": self.plan.size, "overlap": self.plan.overlap,
            "chunks": [
                {
                    "number": number, "first": chunk.frames[0], "last": chunk.frames[-1], "frames": len(chunk.frames),
                    "piece": piece_of.get(number),
                    "reason": self.failed.get(
                        number, None if number in piece_of else _SPARE if number in self.spare else _NOT_NEEDED
                    ),
                    "spare": number in self.spare,
                    "refined": refined.get(f"{CHUNKS_FOLDER}/{_chunk_name(number)}", {}).get("accepted"),
                }
                for number, chunk in enumerate(chunks)
            ],
            "seams": [
                {**joint.as_dict(), "first": number_of[joint.first], "second": number_of[joint.second]}
                for joint in found.joints
            ],
            "loops": [
                {"first": loop.first, "second": loop.second, "similarity": loop.similarity, "matches": loop.matches,
                 "used": loop.reason is None, "reason": loop.reason}
                for loop in loops
            ],
            "pieces": [
                {
                    "folder": _piece_folder(k), "first": own[0], "last": own[-1], "frames": len(own),
                    "ranges": [[run[0], run[-1]] for run in runs(own)],
                }
                for k, own in enumerate(found.frames)
            ],
        }  # fmt: skip

    def _write(
        self, pieces: Sequence[tuple[Sequence[Member], Sequence[int]]], told: dict[str, Any], adaptation: Adaptation
    ) -> dict[str, Any]:
        """Join each piece (chunks and frames) and write its files; the first is the result, and tells of the whole."""
        parts, missing = told["pieces"], len(self.batch) - sum(part["frames"] for part in told["pieces"])
        if len(parts) > 1:
            others = some_of([f"{self._span(part)} in {part['folder']}" for part in parts[1:]])
            self._warn(
                f"The photos fall into {len(parts)} pieces that could not be joined: the result is that of "
                f"{self._span(parts[0])}, and there are {others}."
                + (" Known poses of two photos in each would join them." if self._partly_known else "")
            )
        if missing:
            self._warn(f"{missing} of {len(self.batch)} photos are in no chunk that could be predicted.")
        summary: dict[str, Any] = {}
        made = [self._made(number, *piece, told) for number, piece in enumerate(pieces)]
        for number, (_, frames) in reversed(list(enumerate(pieces))):
            summary = self._write_piece(number, frames, *made[number], told, adaptation)
        self.after(self)
        self.folder.finish()
        return summary

    def _doubt_seams(self, number: int, told: Mapping[str, Any]) -> None:
        """Warn of seams in a piece at which surfaces may be bent."""
        piece_of = {chunk["number"]: chunk["piece"] for chunk in told["chunks"]}
        doubtful = [
            seam
            for seam in told["seams"]
            if seam["used"] and seam["reason"] and seam["kind"] == "neighbours" and piece_of[seam["first"]] == number
        ]
        if doubtful:
            worst = max(doubtful, key=lambda seam: seam["gap"] or 0.0)
            self._warn(
                f"Neighbouring chunks fit badly at {len(doubtful)} seams, worst of all chunks {worst['first']} and "
                f"{worst['second']}: {worst['reason']} Surfaces may be bent or doubled there. Try chunks of "
                "another size (--chunk) that share more photos (--overlap), or a larger model."
            )

    def _span(self, part: Mapping[str, int]) -> str:
        """Return the frames and photos at the ends of a piece, for people."""
        assert self.photos is not None
        first, last = part["first"], part["last"]
        return f"frames {first} to {last} ({self.photos[first].name} to {self.photos[last].name})"

    def _made(
        self, number: int, members: Sequence[Member], frames: Sequence[int], told: dict[str, Any]
    ) -> tuple[Reconstruction, dict[str, Any]]:
        """Write the prediction of a piece, and note in `told` what became of it; returns it, and facts about it."""
        assert self.photos is not None
        folder, photos = self.folder.path / _piece_folder(number), [self.photos[i] for i in frames]
        label = _piece_label(number)
        self.hooks.stage(f"{label}joining {len(members)} chunks")
        result, about = self._joined(folder, members, frames, photos, label, is_tied=number == self.world)
        told["pieces"][number]["together"] = about.pop("together")
        if not (told["pieces"][number]["together"] or {}).get("accepted"):
            self._doubt_seams(number, told)
        return result, about

    def _write_piece(
        self, number: int, frames: Sequence[int], result: Reconstruction, about: dict[str, Any], told: dict[str, Any],
        adaptation: Adaptation,
    ) -> dict[str, Any]:  # fmt: skip
        assert self.photos is not None
        folder, photos = self.folder.path / _piece_folder(number), [self.photos[i] for i in frames]
        label = _piece_label(number)
        if result.has_cameras:
            doubt_focal_length(result, photos)
        with self._timed(f"{label}{FILES_STAGE}", FILTERS):
            wanted = None if self.masks is None else masks_for_model(result, [self.masks[i] for i in frames])
            report, failed = write_files(
                folder, result, self.formats, filters=self.filters, masks=wanted, photos=photos,
                depth_size=self.depth_size, seed=self.seed,
            )  # fmt: skip
        found = Computed(result=result, about=about, adaptation=adaptation)
        # Chunks have the frozen predictions; nobody joined them.
        summary = self._summary(found, report, failed, photos=photos, sequence=told, frozen_prediction=None)
        write_json(folder / SUMMARY_NAME, summary)
        self.hooks.stage(f"{label}report")
        write_report(folder, photos=photos)
        return summary

    def _joined(
        self,
        folder: Path,
        members: Sequence[Member],
        frames: Sequence[int],
        photos: Sequence[PhotoLike],
        label: str,
        *,
        is_tied: bool,
    ) -> tuple[Reconstruction, dict[str, Any]]:
        """Write the prediction of a piece, one frame after the other, and return it as it is on disk, with facts."""
        joined = Joined(members, frames)
        batch, scale = self.batch.select(frames), _common_scale(members)
        T_cam_world, K = joined.T_cam_world, joined.K
        about: dict[str, Any] = {"known_cameras": self._about_known(), "one_camera": None, "together": None}
        factors = np.ones(len(frames))
        if self._partly_known is not None:
            T_cam_world, scale, about["known_cameras"] = self._tied(joined, members, frames, scale, is_tied=is_tied)

        def save() -> Reconstruction:
            save_streamed(
                folder, names=batch.names, photo_hw=batch.photo_hw.numpy(), scale_xy=batch.scale_xy.numpy(),
                offset_xy=batch.offset_xy.numpy(), T_cam_world=T_cam_world, K=K, scale=scale,
                blocks=lambda name: joined.blocks(name, factors),
            )  # fmt: skip
            return Reconstruction.load(folder)

        if self.one_camera:
            known = None if self.known is None else self.known.select(list(frames))
            K, about["one_camera"] = _shared_K(K, batch, photos, known)
        result, tracks = save(), None
        if self.refine:
            with self._timed(f"{label}all photos together", JOINING):
                found = self._refined_together(result)
            about["together"] = _together(found)
            logger.info("all photos together: %s", found.reason)
            if found.accepted:
                assert found.T_cam_world is not None and found.K is not None
                (factors, own), tracks = depth_factors(result, found), found.tracks
                T_cam_world, K = found.T_cam_world, found.K
                result = save()
                self._doubt_followers([result.names[view] for view in np.flatnonzero(~own)])
            about["refinement"] = self._refinement(found)
        metres = self._metres(folder, result, frames, photos)
        if metres is not None:
            T_cam_world, scale, factors = T_cam_world.copy(), metres, factors * metres.value
            T_cam_world[:, :3, 3] *= metres.value
            tracks = None if tracks is None else replace(tracks, xyz=tracks.xyz * metres.value)
            result = save()
        if tracks is not None:
            save_tracks(folder, tracks)
        else:
            files.remove_written(folder / TRACKS_NAME)
        return result, about

    def _refined_together(self, result: Reconstruction) -> Refinement:
        """Bring the cameras of a piece to the matches of all chunks by one bundle adjustment, or say why not."""
        found = [load_matches(self.folder / CHUNKS_FOLDER / name / MATCHES_NAME) for name in self.matched]
        parts = [matches for matches in found if matches is not None]
        if len(parts) < len(found):
            return Refinement(accepted=False, reason=f"{len(found) - len(parts)} chunks have no matches.")
        return refine(result, combined(parts, result.names))

    def _doubt_followers(self, names: Sequence[str]) -> None:
        if names:
            self._warn(f"Too few matches for {some_of(names)}: they follow their neighbours and keep the median scale.")

    def _tied(
        self, joined: Joined, members: Sequence[Member], frames: Sequence[int], scale: Scale | None, *, is_tied: bool
    ) -> tuple[np.ndarray, Scale | None, dict[str, Any]]:
        """Give a piece in the world of known poses these: cameras, scale, and what is said of them."""
        known, about = self._partly_known, self._about_known()
        assert known is not None and about is not None
        used = known.select(list(frames)).without_poses([row for row, i in enumerate(frames) if i in self.odd])
        posed = {i for i, has_pose in zip(frames, used.has_pose, strict=True) if is_tied and has_pose}
        about |= {
            "poses": len(posed), "given": int(known.has_pose.sum()), "odd": [known.names[i] for i in self.odd],
            "chunks": len(members), "untied": sum(posed.isdisjoint(member.chunk.frames) for member in members),
        }  # fmt: skip
        if not is_tied:
            return joined.T_cam_world, scale, about
        factor = float(np.median([float(member.sim3.s) for member in members]))
        found = with_poses(joined.T_cam_world, _uncut(frames, members), used, factor, scale)
        return found.T_cam_world, found.scale, about | dict(found.about)

    def _metres(
        self, folder: Path, result: Reconstruction, frames: Sequence[int], photos: Sequence[PhotoLike]
    ) -> Scale | None:
        """Return what brings a piece to metres; None, with a warning, where --scale says nothing of its photos."""
        if self.scale is None:
            return None
        source = self._scale_of(frames)
        where = f"the piece of {len(frames)} photos between frames {frames[0]} and {frames[-1]}"
        if source is None:
            self._warn(f"--scale says nothing of {where}: its lengths are {result.lengths}.")
            return None
        try:
            return scale_to_metres(result, source, photos)
        except UserError as error:
            if folder == self.folder.path:
                raise
            self._warn(f"--scale cannot be used for {where}: {error}")
            return None

    def _about_known(self) -> dict[str, Any] | None:
        """Return what known cameras made of the chunks: sums and medians of what is said of each."""
        noted = self.folder.notes.get("placing") or {}
        told = [
            value["known_cameras"] for value in noted.values() if isinstance(value, dict) and value.get("known_cameras")
        ]
        if self.known is None or not (told or self._partly_known):
            return None
        medians = _medians([{name: one[name] for name in _KNOWN_MEDIANS} for one in told])
        measured = [one["measured"] for one in told if one.get("measured")]
        sums = {name: sum(one[name] for one in measured) for name in ("points", "views")}
        return {
            "source": self.known.source, "metric": self.known.metric,
            **(medians or dict.fromkeys(_KNOWN_MEDIANS)), "poses": int(self.known.has_pose.sum()),
            "intrinsics": int(self.known.has_K.sum()), "model": self.said_of_known(),
            "measured": {**(_medians(measured) or {}), **sums} if measured else None,
        }  # fmt: skip

    def _refinement(self, whole: Refinement | None = None) -> dict[str, Any] | None:
        """Return what refinement made of the chunks, and of all photos of a piece together.

        Scores are medians over the chunks where it was accepted.
        """
        noted = self.folder.notes.get("refinement") or {}
        own = {f"{CHUNKS_FOLDER}/{_chunk_name(number)}" for number in range(self.count)}
        told = [value for name, value in noted.items() if name in own and "accepted" in value]
        if not told:
            return None
        accepted = [one for one in told if one["accepted"]]
        is_whole = whole is not None and whole.accepted
        refused = Counter(one["reason"] for one in told if not one["accepted"])
        reason = f"The cameras of {len(accepted)} of {len(told)} chunks were brought to matches that prove them."
        if refused:
            reason += f" Of the others, most often: {refused.most_common(1)[0][0]}"
        if whole is not None:
            stay = "" if is_whole else " They stay as their chunks were placed."
            reason += f" All photos together: {whole.reason}{stay}"
        return {
            "accepted": bool(accepted) or is_whole, "reason": reason, "told": any(one["told"] for one in told),
            "lacking": None if accepted or is_whole else Counter(one["lacking"] for one in told).most_common(1)[0][0],
            "probability": _median(one["probability"] for one in accepted), "misfit": None,
            "pairs": sum(one["pairs"] for one in accepted),
            **{name: _medians([one[name] for one in accepted]) for name in ("frozen", "before", "after")},
        }  # fmt: skip

    def _seconds(self) -> dict[str, float]:
        total: dict[str, float] = {}
        for part in self.folder.notes.values():
            own = [part, *(value for name, value in part.items() if name.startswith(CHUNKS_FOLDER))]
            for name, value in (item for one in own for item in one.get("seconds", {}).items()):
                total[name] = round(total.get(name, 0.0) + value, 2)
        return total


def _tried(work: Callable[[ChunkJob], Made], job: ChunkJob) -> tuple[Made | None, str | None]:
    """Return what a chunk's job makes, or why there is no usable prediction; other errors end the run."""
    try:
        return work(job), None
    except (UserError, LostFolderError):
        raise
    except FreeGeoError as error:
        return None, str(error)


def _not_closed(found: Assembly, loop: Loop, parts: Sequence[Chunk], number: int) -> str | None:
    """Return why a loop has no part in the places of chunks; None: its chunk `number` ties both ends together."""
    own = [joint for joint in found.joints if number in (joint.first, joint.second)]
    if any(joint.reason == CONTRADICTED for joint in own):
        return CONTRADICTED
    shared = {
        frame
        for joint in own
        if joint.reason is None
        for frame in {*parts[joint.first].frames} & {*parts[joint.second].frames}
    }
    ends = {2 * frame > loop.first + loop.second for frame in shared}
    return None if len(ends) == 2 else _AT_ONE_END


def _chunk_name(number: int) -> str:
    return f"{number:04d}"


def _tie_name(chunk: Chunk) -> str:
    return f"{chunk.tie}-{chunk.frames[0]:06d}-{chunk.frames[-1]:06d}"


def _piece_folder(number: int) -> str:
    """Where a piece is, below the output folder; the first one is the result itself."""
    return "." if number == 0 else f"{PIECES_FOLDER}/{number + 1}"


def _tying(held: Sequence[Loop], before: Sequence[Loop]) -> list[Loop]:
    """Return those of the loops found that had a chunk of their own."""
    return [loop for loop, known in zip(held, before, strict=True) if known.reason is None]


def _together(found: Refinement) -> dict[str, Any]:
    """Return what reconstruction.json says of the bundle adjustment of all photos of a piece."""
    errors = {"before_px": found.before_px, "after_px": found.after_px}
    return {
        "accepted": found.accepted, "reason": found.reason, "probability": found.probability,
        "pairs": 0 if found.pairs is None else len(found.pairs),
        **{name: None if values is None else float(np.median(values)) for name, values in errors.items()},
    }  # fmt: skip


def _piece_label(number: int) -> str:
    return "" if number == 0 else f"piece {number + 1}: "


def _uncut(frames: Sequence[int], members: Sequence[Member]) -> list[list[int]]:
    """Split the frames of a piece where no chunk holds the last one and the next."""
    together = {pair for member in members for pair in pairwise(member.chunk.frames)}
    parts = [[frames[0]]]
    for before, frame in pairwise(frames):
        if (before, frame) not in together:
            parts.append([])
        parts[-1].append(frame)
    return parts


def _common_scale(members: Sequence[Member]) -> Scale | None:
    """Return what the lengths of chunks being metres rests on; None where they are up to scale."""
    scales = [member.load().scale for member in members]
    known = [scale for scale in scales if scale is not None]
    if len(known) < len(scales):
        return None
    spread = _median(scale.spread for scale in known)
    return Scale(value=float(np.median([scale.value for scale in known])), source=known[0].source, spread=spread)


def _shared_K(
    K: np.ndarray, batch: ImageBatch, photos: Sequence[PhotoLike], known: KnownCameras | None
) -> tuple[np.ndarray, dict[str, Any]]:
    """Give photos of one camera one focal length (`with_one_camera`); pixels have no part in that."""
    maps = np.broadcast_to(np.float32(1), (len(batch), *batch.image_hw))
    bare = Reconstruction(
        depth_z=maps, conf=maps, images=np.broadcast_to(np.uint8(0), (*maps.shape, 3)), names=batch.names,
        photo_hw=batch.photo_hw.numpy(), scale_xy=batch.scale_xy.numpy(), offset_xy=batch.offset_xy.numpy(),
        T_cam_world=np.broadcast_to(np.eye(4), (len(batch), 4, 4)), K=K,
    )  # fmt: skip
    shared, about = with_one_camera(bare, photos, known)
    return shared.cameras()[1], about


def _median(values: Iterable[float | None]) -> float | None:
    found = [value for value in values if value is not None]
    return float(np.median(found)) if found else None


def _medians(scores: Sequence[Mapping[str, Any] | None]) -> dict[str, Any] | None:
    found = [one for one in scores if one]
    return {name: _median(one.get(name) for one in found) for name in found[0]} if found else None


@dataclass(kw_only=True)
class ChunkJob(Job):
    """A chunk of a sequence; the model and its adapter are those of the whole."""

    whole: SequenceJob
    is_tie: bool = False

    @cached_property
    def model(self) -> ReconstructionModel:
        """The model of the whole sequence."""
        return self.whole.model

    @cached_property
    def in_place(self) -> Adapter | None:
        """The adapter of the whole sequence."""
        return self.whole.in_place

    @property
    def _attached(self) -> Adapter | None:
        return self.whole._attached

    def make(self) -> Computed:
        """Write the result of the chunk; an adapter that was trained is judged already."""
        frozen = self.frozen() if self.recipe is not None and not self.is_tie else None
        if frozen is not None and not self.whole.uses_adapter:
            final = frozen
        elif frozen is not None:
            final, rejected = self._adapted_prediction(frozen)
            if rejected is not None:
                self._warn(f"{capital(rejected)} The frozen model's result is used for these frames.")
        else:
            if self.whole.uses_adapter:
                assert self.in_place is not None
            final = self._predicted(self.folder.path, "prediction")
        result, about = self._result(final, frozen)
        self.folder.note("placing", {**self._noted("placing"), **about})
        return Computed(result=result, about=about)
