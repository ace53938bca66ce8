"""The four readings of known cameras against the matches of real photos and of generated rooms.

Every scene's true cameras are written in each reading and read as each other: right readings must be accepted, wrong
ones refused, and of photos without enough matches nothing is checked.

Run: python benchmarks/cameras.py [--rooms 20] [--domains test-id,big,tex] [--scenes FOLDER...]

Each folder of --scenes holds images/ and cameras.json (`frames`: name, K in pixels, w2c 4x4).
"""

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from record import write_result

from freegeo.cameras.convention import READINGS, check_convention, matrix_of, pairs_to_check, pose_of
from freegeo.cameras.known import KnownCamera, KnownCameras
from freegeo.cameras.reading import read_cameras
from freegeo.data.photos import load_photos
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.evidence.matches import find_matches

RESULT = Path(__file__).parent / "results" / "cameras.json"


def room(seed: int, domain: str, frames: int) -> tuple[list, KnownCameras]:
    """Photos of a room and their exact cameras."""
    scene = photograph_room(seed, domain, frames=frames)
    assert scene.T_cam_world is not None
    assert scene.K is not None
    K = scene.K.double().numpy() + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    poses = scene.T_cam_world.double().numpy()
    cameras = tuple(KnownCamera(T_cam_world=T, K=own) for T, own in zip(poses, K, strict=True))
    names = tuple(photo.name for photo in scene.photos)
    return list(scene.photos), KnownCameras(names=names, cameras=cameras, source=scene.name)


def misread(known: KnownCameras, meant: str, read: str) -> KnownCameras:
    """Return cameras written in one reading and read in another."""
    cameras = []
    for one in known.cameras:
        assert one.T_cam_world is not None
        cameras.append(replace(one, T_cam_world=pose_of(matrix_of(one.T_cam_world, meant), read)))
    return replace(known, cameras=tuple(cameras), convention=read)


def judged(photos: list, known: KnownCameras) -> tuple[dict, Counter]:
    """Return errors, with given and with fitted focal lengths, and verdicts on the 16 ways to write and read."""
    matches = find_matches(photos, pairs_to_check(len(photos)))
    bare = replace(known, cameras=tuple(replace(one, K=None) for one in known.cameras))
    found, fitted = check_convention(known, matches), check_convention(bare, matches)
    verdicts = Counter()
    for meant in READINGS:
        for read in READINGS:
            outcome = check_convention(misread(known, meant, read), matches).outcome
            verdicts[f"{'right' if meant == read else 'wrong'} reading {outcome}"] += 1
    row = {"pairs": found.pairs, "errors_px": dict(found.errors), "behind": dict(found.behind)}
    return {**row, "fitted_focal_px": dict(fitted.errors), "fitted_outcome": fitted.outcome}, verdicts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=20, help="rooms of each domain")
    parser.add_argument("--domains", default="test-id,big,tex,sparse,light")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--scenes", nargs="*", type=Path, default=[])
    arguments = parser.parse_args()
    rows: dict[str, dict] = {}
    verdicts: dict[str, Counter] = {}
    for folder in arguments.scenes:
        photos = load_photos(folder / "images")
        known = replace(read_cameras(folder / "cameras.json", photos), source=folder.name)
        rows[folder.name], verdicts[folder.name] = judged(photos, known)
        print(folder.name, rows[folder.name], dict(verdicts[folder.name]), flush=True)
    for domain in arguments.domains.split(","):
        verdicts[domain] = Counter()
        for seed in get_domain(domain).seeds(arguments.rooms):
            photos, known = room(seed, domain, arguments.frames)
            rows[known.source], counted = judged(photos, known)
            verdicts[domain] += counted
        print(domain, dict(verdicts[domain]), flush=True)
    settings = {"rooms": arguments.rooms, "frames": arguments.frames, "scenes": [f.name for f in arguments.scenes]}
    write_result(
        RESULT,
        settings=settings,
        results={"verdicts": verdicts, "scenes": rows},
        packages=("torch", "opencv-python-headless"),
        show=False,
    )


if __name__ == "__main__":
    main()
