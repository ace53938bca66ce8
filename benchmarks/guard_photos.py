"""Does the guard's rule tell better predictions from worse ones on real photos? (docs/guard.md, "Real photos")

Run: python benchmarks/guard_photos.py FOLDER... [--seeds 4] [--out FILE]

Each FOLDER holds images/ and cameras.json (`frames`: name, K in pixels, w2c 4x4). No network is involved. The frozen
prediction is the truth with errors that hang together, as a network's do: a bent path, single cameras turned, steps and
depth that grow along the path, one wrong focal length, depth that tilts in each view. Candidates have the same errors
times a factor (a step towards the truth, or away from it), or other errors of some size (another network's). True depth
is that of the tracks by the true cameras, interpolated.

A candidate is better or worse when the median pose error of all pairs falls or rises by more than 2 %.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from collections import Counter
from pathlib import Path

import numpy as np
from record import write_result
from refine import known_photos, perturbed, true_points, with_cameras, with_errors
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from freegeo.evidence.candidate import Candidate
from freegeo.evidence.guard import GuardSettings, Reference, State, judge, too_little
from freegeo.evidence.matches import find_matches
from freegeo.export.reconstruction import Reconstruction
from freegeo.metrics.pose import pair_errors

IMAGE_HW = (96, 128)
SIZES_DEG = (2.0, 0.5)
"""Median rotation error of the frozen prediction."""
SAME = (0.0, 0.25, 0.5, 0.75, 0.9, 0.95, 1.05, 1.1, 1.25, 1.5, 2.0)
OTHER = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
GROWTH, FOCAL, TILT = 0.1, 0.02, 0.05
"""Errors of the frozen prediction beside its turns, at 2 degrees."""
WHOLE = State(steps=1.0, strength=1.0)
CHANGE = 0.02


def true_depth(exact: Reconstruction, points) -> np.ndarray:
    """Depth (S, H, W) interpolated between the tracks of each view."""
    height, width = exact.image_hw
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    depth = np.empty_like(exact.depth_z)
    for view, (pixel, z) in enumerate(points):
        known = np.isfinite(z) & (z > 0)
        place = (pixel[known] + 0.5) * exact.scale_xy[view] - 0.5
        depth[view] = LinearNDInterpolator(place, z[known])(column, row)
        outside = np.isnan(depth[view])
        depth[view][outside] = NearestNDInterpolator(place, z[known])(column, row)[outside]
    return depth


def with_size(exact: Reconstruction, truth, depth_z: np.ndarray, degrees: float, seed: int) -> Reconstruction:
    """The true prediction with errors of a size."""
    share = degrees / 2
    rng = np.random.default_rng(seed)
    count, (height, width) = len(truth), exact.image_hw
    tilt = rng.normal(size=(2, count, 1, 1)) * share * TILT
    row, column = np.linspace(-1, 1, height)[None, :, None], np.linspace(-1, 1, width)[None, None]
    # Depth grows along the path as the steps do.
    along = np.linspace(1 - share * GROWTH, 1 + share * GROWTH, count)[:, None, None]
    wrong = depth_z * along * np.exp(tilt[0] * row + tilt[1] * column)
    T = perturbed(truth, degrees, seed, growth=share * GROWTH)
    return with_errors(exact, T, 1 + share * FOCAL * (-1) ** seed, wrong)


def study(folder: Path, seeds: int) -> list[dict]:
    """All candidates of one folder; one row each."""
    images, truth, K = known_photos(folder)
    matches = find_matches(images)
    exact = with_cameras(images, matches, truth, K, IMAGE_HW)
    depth_z = true_depth(exact, true_points(exact, matches, truth))
    rows = []
    for size in SIZES_DEG:
        for seed in range(seeds):
            frozen = with_size(exact, truth, depth_z, size, seed)
            reference = Reference.of(Candidate.of(frozen), matches)
            base = reference.measure(reference.candidate)
            assert not too_little(base, [matches], GuardSettings())
            before = float(pair_errors(reference.candidate.T_cam_world, truth).worst_deg.median())
            kinds = [("same", k, seed) for k in SAME] + [("other", k, seed + 100) for k in OTHER]
            for kind, factor, drawn in kinds:
                candidate = Candidate.of(with_size(exact, truth, depth_z, factor * size, drawn))
                after = float(pair_errors(candidate.T_cam_world, truth).worst_deg.median())
                verdict = judge(base, [(WHOLE, reference.measure(candidate))], GuardSettings())
                trial = verdict.trials[0]
                rows.append(
                    {
                        "scene": folder.name, "degrees": size, "seed": seed, "kind": kind, "factor": factor,
                        "before_deg": before, "after_deg": after, "accepted": verdict.outcome == "adapted",
                        "gain": trial.gain, "probability": trial.probability, "veto": trial.veto,
                    }
                )  # fmt: skip
    return rows


def truly(row: dict) -> str:
    change = row["after_deg"] / row["before_deg"] - 1
    return "better" if change < -CHANGE else "worse" if change > CHANGE else "equal"


def table(rows: list[dict]) -> str:
    """How many candidates of each kind the rule accepts."""
    lines = ["| scene | error | candidates | better, accepted | worse, accepted | vetoed |", "|---" * 6 + "|"]
    scenes = [*dict.fromkeys(row["scene"] for row in rows), None]
    for scene in scenes:
        for size in SIZES_DEG:
            for kind in ("same", "other"):
                own = [r for r in rows if scene in (r["scene"], None) and (r["degrees"], r["kind"]) == (size, kind)]
                total, taken = Counter(map(truly, own)), Counter(truly(row) for row in own if row["accepted"])
                vetoed = Counter(truly(row) for row in own if row["veto"] and row["probability"] >= 0.9)
                lines.append(
                    f"| {scene or 'all'} | {size:g} | {kind} | {taken['better']} of {total['better']} "
                    f"| {taken['worse']} of {total['worse']} | {vetoed['better']} better, {vetoed['worse']} worse |"
                )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    rows = [row for folder in arguments.folders for row in study(folder, arguments.seeds)]
    print(table(rows))
    if arguments.out:
        settings = {"sizes_deg": SIZES_DEG, "same": SAME, "other": OTHER, "seeds": arguments.seeds}
        wrong = [row for row in rows if row["accepted"] != (truly(row) == "better") and truly(row) != "equal"]
        write_result(arguments.out, settings=settings, results={"table": table(rows), "wrong": wrong}, show=False)


if __name__ == "__main__":
    main()
