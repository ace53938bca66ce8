"""Score S5 (cameras of rays against those of the camera head) as a veto of the guard, on generated rooms.

    python benchmarks/two_heads.py record -o out/heads --domains test-id tex big sparse --rooms 4 --seed 44
    python benchmarks/two_heads.py report out/heads

`record` adapts the embedded model to frames 0 to 11 of each room as `guard.py` does, scores the states of the adapter
on these frames by the guard's measures and by S5, and writes one file a room; rooms that have a file are skipped.
`report` prints the true gains of the states that the guard chooses, with and without the veto, and how S5 and the
guard's gain rank the states (docs/guard.md, "What it does not do"). One thread.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from guard import ADAPTED_TO, CANDIDATES, FROZEN, SHARES, command_line, trained

from freegeo import files
from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.samples import SceneImages
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import camera_difference
from freegeo.evidence.guard import GuardSettings, Reference, State, judge, too_little
from freegeo.evidence.matches import find_matches
from freegeo.metrics.scene import evaluate
from freegeo.models.catalog import load_model
from freegeo.models.precision import Compute
from freegeo.pipeline import predict

LOSS = 0.1
"""Growth of S5 in degrees that would be a veto."""
METRICS = ("auc15", "auc30", "f1_rel5")


def record(folder: Path, domain: str, room: int, *, seed: int) -> None:
    """Adapt to one room and write its file."""
    file = folder / f"{domain}-{room:03d}-seed{seed}.json"
    if file.is_file():
        return
    scene = photograph_room(next(iter(get_domain(domain).seeds(1, start=room))), domain, frames=16).select(ADAPTED_TO)
    model = load_model("freegeo-tiny")
    batch = model.preprocess(scene.photos)
    plan = recipes.scene(model.spec)
    states = {}

    def keep(progress) -> None:
        if (progress.step + 1) / plan.steps in (*SHARES, 1.0):
            states[(progress.step + 1) / plan.steps] = trained(model)

    made = adapt(model, [SceneImages.from_batch("room", batch)], plan, seed=seed, compute=Compute(), on_step=keep)
    matches, measured, rows = find_matches(scene.photos), {}, {}
    reference = None
    for share, strength in CANDIDATES:
        made.adapter.load(states[share])
        made.adapter.set_strength(strength)
        found, rays = predict(model, batch), predict(model, batch, pose_from="rays")
        candidate = Candidate.of(found)
        reference = reference or Reference.of(candidate, matches)
        measured[share, strength] = reference.measure(candidate)
        apart = camera_difference(candidate, *(torch.from_numpy(values) for values in rays.cameras()))
        truth = evaluate(found, scene)
        rows[share, strength] = {"s5": apart.pose_deg, **{name: truth[name] for name in METRICS}}
    base = measured[FROZEN]
    told = too_little(base, [matches], GuardSettings())
    for name in ("guard", "with S5"):
        tried = [
            (State(steps=one[0], strength=one[1]), measured[one])
            for one in CANDIDATES[1:]
            if name == "guard" or rows[one]["s5"] <= (1 + LOSS) * rows[FROZEN]["s5"]
        ]
        verdict = None if told else judge(base, tried, GuardSettings())
        if verdict is not None and name == "guard":
            for trial in verdict.trials:
                rows[trial.state.steps, trial.state.strength]["gain"] = trial.gain
        chosen = None if verdict is None or verdict.chosen is None else verdict.chosen.state
        rows[name] = rows[FROZEN if chosen is None else (chosen.steps, chosen.strength)]
    files.write_json(file, {str(key): row for key, row in rows.items()})
    print(file.name, flush=True)


def report(folder: Path) -> None:
    """Print gains of the choices, and rank correlations."""
    from scipy.stats import spearmanr

    rooms = [json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))]
    frozen, states = str(FROZEN), [str(one) for one in CANDIDATES[1:]]
    print(f"{len(rooms)} rooms; S5 of the frozen model {np.median([room[frozen]['s5'] for room in rooms]):.1f} degrees")
    grown = [room[state]["s5"] > (1 + LOSS) * room[frozen]["s5"] for room in rooms for state in states]
    print(f"states with S5 grown by more than {LOSS:.0%}: {np.mean(grown):.0%}")
    for metric in METRICS:
        gains = {key: [room[key][metric] - room[frozen][metric] for room in rooms] for key in ("guard", "with S5")}
        gains["always"] = [room[str((1.0, 1.0))][metric] - room[frozen][metric] for room in rooms]
        told = (f"{key} {np.mean(values):+.3f} (worst {min(values):+.3f})" for key, values in gains.items())
        print(metric, "  ".join(told))
        true = [room[state][metric] - room[frozen][metric] for room in rooms for state in states]
        fall = [room[frozen]["s5"] - room[state]["s5"] for room in rooms for state in states]
        judged = [room[state].get("gain", np.nan) for room in rooms for state in states]
        ranks = [spearmanr(true, score, nan_policy="omit").statistic for score in (fall, judged)]
        print(f"  rank correlation with the true gain: fall of S5 {ranks[0]:+.2f}, gain by matches {ranks[1]:+.2f}")


if __name__ == "__main__":
    command_line(__doc__, record, report)
