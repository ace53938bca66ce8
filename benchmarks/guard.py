"""Record what the guard's study needs: true gains and label-free scores of adapter states on generated rooms.

    python benchmarks/guard.py record -o out/guard --domains val-id val-big --rooms 12 [--start 0] [--hold 1]
    python benchmarks/guard.py report out/guard

`record` adapts the embedded model to frames 0 to 11 of each room (256 x 192 photos), predicts sets of frames with
states of the adapter, and writes one file a room; rooms that have a file are skipped, so it can be stopped and started
again. `report` prints the tables of docs/guard.md from these files. One thread; a room takes about half a minute.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from freegeo import files
from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.samples import SceneImages
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import depth_agreement
from freegeo.evidence.guard import SHARES, STRENGTHS, Reference
from freegeo.evidence.matches import find_matches
from freegeo.evidence.scores import two_view
from freegeo.metrics.scene import evaluate
from freegeo.models.catalog import load_model
from freegeo.models.precision import Compute
from freegeo.pipeline import predict

ADAPTED_TO = list(range(12))
SETS = {
    "seen-4": [[0, 2, 4, 6], [4, 6, 8, 10]],
    "seen-8": [list(range(8)), list(range(4, 12))],
    "seen-12": [ADAPTED_TO],
    "unseen-4": [[12, 13, 14, 15]],
    "all-16": [list(range(16))],
}
JUDGED = "seen-12"
METRICS = ("auc03", "auc05", "auc15", "auc30", "f1_rel5", "abs_rel")
FROZEN = (1.0, 0.0)
CANDIDATES = [FROZEN, *((1.0, s) for s in STRENGTHS), *((share, 1.0) for share in SHARES)]


def record(folder: Path, domain: str, room: int, *, hold: float, seed: int) -> None:
    """Adapt to one room and write its file."""
    file = folder / f"{domain}-{room:03d}-hold{hold:g}-seed{seed}.npz"
    if file.is_file():
        return
    started = time.monotonic()
    scene = photograph_room(next(iter(get_domain(domain).seeds(1, start=room))), domain, frames=16)
    model = load_model("freegeo-tiny")
    batch = model.preprocess(scene.photos)
    matches = find_matches(scene.select(ADAPTED_TO).photos)
    plan = recipes.scene(model.spec).changed(hold=hold)
    states, count = {}, plan.steps

    def keep(progress) -> None:
        if (progress.step + 1) / count in SHARES:
            states[(progress.step + 1) / count] = trained(model)

    made = adapt(
        model, [SceneImages.from_batch("room", batch.select(ADAPTED_TO))], plan, seed=seed, compute=Compute(),
        on_step=keep,
    )  # fmt: skip
    adapted_at = time.monotonic()
    states[1.0] = trained(model)
    arrays: dict[str, np.ndarray] = {"pairs": matches.pairs, "counts": matches.counts, "flatness": matches.flatness}
    arrays["loss"] = np.array([step["total"] for step in made.curve])
    reference = None
    for share, strength in CANDIDATES:
        made.adapter.load(states[share])
        made.adapter.set_strength(strength)
        key = f"{share:g}-{strength:g}"
        for name, sets in SETS.items():
            found = [predict(model, batch.select(frames)) for frames in sets]
            truth = [evaluate(one, scene.select(frames)) for one, frames in zip(found, sets, strict=True)]
            arrays[f"{key}/{name}"] = np.array([[row[m] for m in METRICS] for row in truth]).mean(axis=0)
            if name == JUDGED:
                candidate = Candidate.of(found[0])
                reference = reference or Reference.of(candidate, matches)
                arrays |= {f"{key}/{score}": value for score, value in scored(candidate, reference).items()}
    arrays["seconds"] = np.array([adapted_at - started, time.monotonic() - started])
    files.write_npz(file, arrays)
    print(file.name, f"{arrays['seconds'][1]:.0f} s, {len(matches.pairs)} pairs", flush=True)


def scored(candidate: Candidate, reference: Reference) -> dict[str, np.ndarray]:
    """All scores of one prediction."""
    measured = reference.measure(candidate)
    angles, fixed = two_view(candidate, reference.matches), depth_agreement(candidate, reference.common)
    return {
        "s1": measured.epipolar.values,
        "s1b": np.stack((angles.rotation_deg, angles.translation_deg)),
        "s2": measured.reprojection.values,
        "s2g": np.array(measured.drift),
        "s3": np.array([measured.agreement, measured.agreement_before]),
        "s3-fixed": np.array([fixed.mean_share, fixed.mean_log_ratio]),
    }


def trained(model) -> dict[str, torch.Tensor]:
    """The parameters in training, by the names that `Adapter.load` reads."""
    named = {name: p.detach().clone() for name, p in model.named_parameters() if p.requires_grad}
    return {
        "camera_token" if name == model.camera_token_name else name.replace(".default.", "."): value
        for name, value in named.items()
    }


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    recording = commands.add_parser("record")
    recording.add_argument("-o", "--output", type=Path, required=True)
    recording.add_argument("--domains", nargs="+", required=True)
    recording.add_argument("--rooms", type=int, required=True)
    recording.add_argument("--start", type=int, default=0)
    recording.add_argument("--hold", type=float, default=1.0)
    recording.add_argument("--seed", type=int, default=43)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for room in range(options.start, options.start + options.rooms):
        for domain in options.domains:
            record(options.output, domain, room, hold=options.hold, seed=options.seed)


if __name__ == "__main__":
    main()
