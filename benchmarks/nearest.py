"""Nearest-neighbour distances between two room-sized clouds: plain cKDTree on unordered points against ours.

Ours (`freegeo.metrics.cloud`) sorts both clouds along a Z-curve, as voxel averaging leaves them, and builds the tree
without compact nodes. "near" compares two noisy samples of one room, "far" a room with a third of it (most of its
points lie far from the other cloud, as in scores of few views). The distances must be equal.

Run: python benchmarks/nearest.py [--points 300000]
"""

import argparse
import time
from pathlib import Path

import numpy as np
from record import write_result
from scipy.spatial import cKDTree

from freegeo.metrics.cloud import morton_order, nearest_distances

ROOM = np.array([6.0, 3.0, 5.0])


def room_cloud(count: int, rng: np.random.Generator) -> np.ndarray:
    """Noisy points (count, 3) on the walls, floor and ceiling of a room, in random order."""
    points = rng.uniform(0, 1, (count, 3)) * ROOM
    axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
    points[np.arange(count), axis] = side * ROOM[axis]
    return points + rng.normal(0, 0.005, (count, 3))


def plain(query: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return cKDTree(reference).query(query, workers=-1)[0]


def tuned(query: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return cKDTree(reference, leafsize=32, balanced_tree=False, compact_nodes=False).query(query, workers=-1)[0]


def timed(function, *clouds: np.ndarray) -> tuple[np.ndarray, dict[str, float]]:
    """Distances, and the times of the fastest of three runs."""
    runs = []
    for _ in range(3):
        wall, cpu = time.perf_counter(), time.process_time()
        distances = function(*clouds)
        runs.append({"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall})
    return distances, min(runs, key=lambda run: run["cpu_s"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=300_000)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "nearest.json")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    query, reference = room_cloud(options.points, rng), room_cloud(options.points, rng)
    third = reference[reference[:, 0] < ROOM[0] / 3]
    results = {}
    for name, (a, b) in {"near": (query, reference), "far": (query, third)}.items():
        distances, before = timed(plain, a, b)
        sorted_a, sorted_b = a[morton_order(a)], b[morton_order(b)]
        ours, with_sorting = timed(nearest_distances, a, b)
        _, presorted = timed(tuned, sorted_a, sorted_b)
        results[name] = {
            "plain": before,
            "ours_with_sorting": with_sorting,
            "ours_on_averaged_clouds": presorted,
            "times_faster_cpu": before["cpu_s"] / presorted["cpu_s"],
            "times_faster_cpu_with_sorting": before["cpu_s"] / with_sorting["cpu_s"],
            "equal_distances": bool(np.array_equal(distances, ours)),
        }
    write_result(options.out, settings={"points": options.points}, results=results, packages=("numpy", "scipy"))


if __name__ == "__main__":
    main()
