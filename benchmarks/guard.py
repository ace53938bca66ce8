"""Record what the guard's study needs: true gains and label-free scores of adapter states on generated rooms.

    python benchmarks/guard.py record -o out/guard --domains val-id val-big --rooms 12 [--start 0] [--hold 1]
    python benchmarks/guard.py report out/guard

`record` adapts the embedded model to frames 0 to 11 of each room (256 x 192 photos), predicts sets of frames with
states of the adapter, and writes one file a room; rooms that have a file are skipped, so it can be stopped and started
again. `report` prints the tables of docs/guard.md from these files. One thread; a room takes about a minute and a half.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from text_tables import change, in_order, mean_and_worst, signed, table

from freegeo import files
from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.samples import SceneImages
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import depth_agreement
from freegeo.evidence.guard import (
    SHARES,
    STRENGTHS,
    GuardSettings,
    Measurement,
    Reference,
    State,
    Verdict,
    judge,
)  # fmt: skip
from freegeo.evidence.matches import find_matches
from freegeo.evidence.refinement import bring_depth, refine
from freegeo.evidence.scores import PairScores, two_view
from freegeo.export.reconstruction import Reconstruction
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
NOISE = 0.005
"""True changes of a score up to this have no sign worth predicting."""
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
    judged: dict[tuple[float, float], Reconstruction] = {}
    measured: dict[tuple[float, float], Measurement] = {}
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
                judged[share, strength], measured[share, strength] = found[0], reference.measure(candidate)
                scores = scored(candidate, reference, measured[share, strength])
                arrays |= {f"{key}/{score}": value for score, value in scores.items()}
    chosen = chosen_state(measured, GuardSettings())
    for name, state in (("frozen", FROZEN), ("guarded", chosen)):
        refinement = refine(judged[state], matches)
        result = bring_depth(judged[state], refinement)[0] if refinement.accepted else judged[state]
        row = evaluate(result, scene.select(ADAPTED_TO))
        arrays[f"refined-{name}"] = np.array([row[m] for m in METRICS])
        arrays[f"refined-{name}/accepted"] = np.array(refinement.accepted)
    arrays["seconds"] = np.array([adapted_at - started, time.monotonic() - started])
    files.write_npz(file, arrays)
    print(file.name, f"{arrays['seconds'][1]:.0f} s, {len(matches.pairs)} pairs", flush=True)


def scored(candidate: Candidate, reference: Reference, measured: Measurement) -> dict[str, np.ndarray]:
    """All scores of one prediction."""
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


class Room:
    """One recorded room."""

    def __init__(self, file: Path):
        with np.load(file) as content:
            self.arrays = dict(content)
        self.domain = file.name.rsplit("-", 3)[0]

    def gain(self, candidate: tuple[float, float], name: str, metric: str) -> float:
        """Change of a metric against the frozen model; above 0 is better for all but abs_rel."""
        column = METRICS.index(metric)
        return float(self.arrays[f"{_key(candidate)}/{name}"][column] - self.arrays[f"{_key(FROZEN)}/{name}"][column])

    def measured(self, candidate: tuple[float, float]) -> Measurement:
        """The recorded scores."""
        pairs, key = self.arrays["pairs"], _key(candidate)
        s1, s2 = (
            PairScores(pairs=pairs, values=self.arrays[f"{key}/{name}"], used=self.arrays["counts"], reason=None)
            for name in ("s1", "s2")
        )
        after, before = self.arrays[f"{key}/s3"]
        return Measurement(
            epipolar=s1, reprojection=s2, drift=float(self.arrays[f"{key}/s2g"]), agreement=float(after),
            agreement_before=float(before),
        )  # fmt: skip

    def refined(self, name: str, metric: str) -> float:
        """Change of a metric of the judged set against the frozen model, after bundle adjustment."""
        column = METRICS.index(metric)
        return float(self.arrays[f"refined-{name}"][column] - self.arrays[f"{_key(FROZEN)}/{JUDGED}"][column])

    def verdict(self, settings: GuardSettings) -> Verdict:
        """What the guard would have said."""
        return verdict({state: self.measured(state) for state in CANDIDATES}, settings)


def verdict(measured: dict[tuple[float, float], Measurement], settings: GuardSettings) -> Verdict:
    """The rule of `try_states`, on measurements that are there."""
    base = measured[FROZEN]
    known = np.isfinite(base.epipolar.values) & np.isfinite(base.reprojection.values)
    covered = len(np.unique(base.epipolar.pairs[known]))
    if known.sum() < settings.pairs or covered < settings.views * len(ADAPTED_TO):
        return Verdict(outcome="unknown", reason="", frozen=base)
    return judge(base, [(State(steps=share, strength=s), measured[share, s]) for share, s in CANDIDATES[1:]], settings)


def chosen_state(measured: dict[tuple[float, float], Measurement], settings: GuardSettings) -> tuple[float, float]:
    """The state that the guard uses."""
    chosen = verdict(measured, settings).chosen
    return FROZEN if chosen is None else (chosen.state.steps, chosen.state.strength)


def _key(candidate: tuple[float, float]) -> str:
    return f"{candidate[0]:g}-{candidate[1]:g}"


PHOTOS = {
    "seen-4": "4 of those adapted to",
    "seen-8": "8 of those adapted to",
    "seen-12": "all 12 of them, what the guard judges",
    "unseen-4": "4 that adaptation never saw",
    "all-16": "16, four of them never seen",
}
SHOWN = {"auc15": "AUC@15", "auc30": "AUC@30", "f1_rel5": "F1 (5 %)"}
BY_DOMAIN = (("auc15", "seen-4"), ("auc15", JUDGED), ("f1_rel5", JUDGED), ("auc30", "all-16"), ("f1_rel5", "all-16"))


def report(folder: Path) -> None:
    """Print the tables of docs/guard.md."""
    rooms = [Room(file) for file in sorted(folder.glob("*.npz"))]
    settings = GuardSettings()
    domains = {name: [room for room in rooms if room.domain == name] for name in in_order(r.domain for r in rooms)}
    states = {room: chosen_state({c: room.measured(c) for c in CANDIDATES}, settings) for room in rooms}

    def gains(group: list[Room], name: str, metric: str) -> dict[str, np.ndarray]:
        return {
            "always": np.array([room.gain((1.0, 1.0), name, metric) for room in group]),
            "guard": np.array([room.gain(states[room], name, metric) for room in group]),
            "best": np.array([max(room.gain(c, name, metric) for c in CANDIDATES) for room in group]),
        }

    for domain, group in {**domains, "all": rooms}.items():
        said = Counter(room.verdict(settings).outcome for room in group)
        told = (f"{outcome} {said[outcome]}" for outcome in ("adapted", "frozen", "unknown"))
        print(f"{domain}: {len(group)} rooms, {', '.join(told)}")
    lines = []
    for name, photos in PHOTOS.items():
        for row, (metric, score) in enumerate(SHOWN.items()):
            found = gains(rooms, name, metric)
            cells = [mean_and_worst(found["always"]), change(found["guard"]), signed(found["best"].mean())]
            lines.append(["" if row else photos, score, *cells])
    print("\n" + table(("photos", "score", "always adapted", "guard", "best state in hindsight"), lines))
    lines = []
    for metric, score in SHOWN.items():
        found = gains(rooms, JUDGED, metric)
        refined = [change([room.refined(kind, metric) for room in rooms]) for kind in ("frozen", "guarded")]
        lines.append([score, "0", *(mean_and_worst(found[kind]) for kind in ("always", "guard")), *refined])
    print("\n" + table(("score", "frozen", "always adapted", "guard", "refined, frozen", "refined, guard"), lines))
    lines, means = [], []
    for domain, group in domains.items():
        cells = []
        for metric, name in BY_DOMAIN:
            found = gains(group, name, metric)
            cells.append(f"{signed(found['guard'].mean())} / {signed(found['always'].mean())}")
        lines.append([domain, *cells])
        judged = [gains(group, name, metric) for name in PHOTOS if name != "unseen-4" for metric in SHOWN]
        means += [found["guard"].mean() for found in judged]
    headings = (f"{SHOWN[metric].removesuffix(' (5 %)')}, {name.split('-')[1]} photos" for metric, name in BY_DOMAIN)
    print("\n" + table(("rooms", *headings), lines))
    low = sum(mean < -0.003 for mean in means)
    print(f"\nOf {len(means)} means of the guard by domain {low} are below -.003, the least is {signed(min(means))}.")
    for score in ("s1", "s2", "s3", "s3-fixed", "s1b"):
        told = {
            f"{name} {metric}": agreement(rooms, score, name, metric)
            for name in ("seen-4", "seen-12", "all-16")
            for metric in ("auc30", "f1_rel5")
        }
        print(f"rank correlation of {score}:", ", ".join(f"{what} {rank:+.2f}" for what, (rank, _) in told.items()))
        print(
            f"same sign, of changes above {NOISE}:", ", ".join(f"{what} {same:.0%}" for what, (_, same) in told.items())
        )
    print(f"seconds a room: {np.mean([room.arrays['seconds'][1] for room in rooms]):.0f}")


def agreement(rooms: list[Room], score: str, name: str, metric: str) -> tuple[float, float]:
    """Compare a score's gain with the true gain, over rooms and candidates.

    Returns:
        Spearman correlation, and the share of the true changes above `NOISE` of which the score has the sign.
    """
    from scipy.stats import spearmanr

    true, told = [], []
    for room in rooms:
        for candidate in CANDIDATES[1:]:
            before, after = (np.asarray(room.arrays[f"{_key(c)}/{score}"], float) for c in (FROZEN, candidate))
            if score in ("s1", "s2"):
                change = np.nanmean(np.log(before + 0.05) - np.log(after + 0.05)) if len(before) else np.nan
            elif score == "s1b":
                change = np.nanmean(before - after)
            else:
                change = after[0] - (after[1] if score == "s3" else before[0])
            if np.isfinite(change):
                true.append(room.gain(candidate, name, metric))
                told.append(change)
    found, signs = np.array(true), np.sign(told) == np.sign(true)
    return float(spearmanr(true, told).statistic), float(signs[np.abs(found) > NOISE].mean())


def command_line(about: str, record: Callable[..., None], report: Callable[[Path], None], **more: float) -> None:
    """Run `record` for every room that the command line names, or `report`; `more` are further options of `record`."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    recording = commands.add_parser("record")
    recording.add_argument("-o", "--output", type=Path, required=True)
    recording.add_argument("--domains", nargs="+", required=True)
    recording.add_argument("--rooms", type=int, required=True)
    recording.add_argument("--start", type=int, default=0)
    recording.add_argument("--seed", type=int, default=43)
    for name, default in more.items():
        recording.add_argument(f"--{name}", type=float, default=default)
    reporting = commands.add_parser("report")
    reporting.add_argument("folder", type=Path)
    options = parser.parse_args()
    if options.command == "report":
        report(options.folder)
        return
    torch.set_num_threads(1)
    for room in range(options.start, options.start + options.rooms):
        for domain in options.domains:
            given = {name: getattr(options, name) for name in more}
            record(options.output, domain, room, seed=options.seed, **given)


if __name__ == "__main__":
    command_line(__doc__, record, report, hold=1.0)
