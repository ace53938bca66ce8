"""What bundle adjustment of matches gains: on generated rooms with the embedded model, and on real photos.

Run: python benchmarks/refine.py rooms [--domains test-id,big,...] [--rooms 8] [--views 8] [--out FILE]
     python benchmarks/refine.py photos FOLDER... [--degrees 2] [--focal 0.02] [--out FILE]
     python benchmarks/refine.py report FOLDER      (the tables of docs/refinement.md from all `rooms` files below it)

`rooms`: frozen predictions of `freegeo-tiny`, before and after refinement (a refused refinement changes nothing), with
the change of every score and its interval, paired over rooms (docs/embedded-model.md describes the rooms).

`photos`: each FOLDER holds images/ and cameras.json (`frames`: name, K in pixels, w2c 4x4). There is no depth, so the
prediction's cameras are the true ones with errors that hang together, as a network's do: one wrong focal length, a
bending of the path, a drift of its scale, and a rest of independent turns.

Times are CPU seconds of this process on one thread.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from record import write_result
from text_tables import change, in_order, plain, table

from freegeo.data.photos import load_photos
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import Matches, find_matches
from freegeo.evidence.refinement import Refinement, bring_depth, depth_misfit, parallax_px, refine
from freegeo.evidence.tracks import join_matches, triangulate
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.depth import valid_depth
from freegeo.metrics.pose import pair_errors, pose_auc
from freegeo.metrics.scene import evaluate
from freegeo.models.images import read_photos
from freegeo.pipeline import predict
from freegeo.types import PhotoLike, Priors

DOMAINS = "test-id,big,tex,sparse,light"
SCORES = ("auc05", "auc15", "auc30", "f1_rel5", "abs_rel")


def rooms(arguments: argparse.Namespace) -> list[dict]:
    """Measure generated rooms; one row each."""
    import freegeo

    model = freegeo.load_model("freegeo-tiny")
    rows = []
    for domain in arguments.domains.split(","):
        for seed in get_domain(domain).seeds(arguments.rooms, start=arguments.first):
            scene = photograph_room(seed, domain, frames=max(16, arguments.views))
            # The first views of the path, as a user would take them.
            scene = replace(
                scene,
                photos=scene.photos[: arguments.views],
                T_cam_world=scene.T_cam_world[: arguments.views],
                K=scene.K[: arguments.views],
                depth_z=scene.depth_z[: arguments.views],
            )
            started = time.process_time()
            matches = find_matches(scene.photos)
            matched = time.process_time() - started
            frozen = freegeo.reconstruct(model, scene.photos)
            started = time.process_time()
            refinement = refine(frozen, matches)
            seconds = time.process_time() - started
            before = evaluate(frozen, scene)
            rows.append(
                {
                    "domain": domain,
                    "seed": seed,
                    "before": before,
                    "after": _scores(frozen, refinement, scene, before),
                    "affine": _scores(frozen, refinement, scene, before, affine=True),
                    "unjudged": _scores(frozen, _accepted(refinement), scene, before),
                    "match_s": matched,
                    "refine_s": seconds,
                    **_told(refinement, matches),
                    **_second(model, scene, frozen, refinement),
                }
            )
            print(_line(rows[-1]), flush=True)
    return rows


def _scores(frozen: Reconstruction, refinement: Refinement, scene, before: dict, *, affine: bool = False) -> dict:
    if not refinement.accepted:
        return before
    return evaluate(bring_depth(frozen, refinement, affine=affine)[0], scene)


def _second(model, scene, frozen: Reconstruction, refinement: Refinement) -> dict:
    """F1 with the depth of a prediction that was told the refined cameras, and the misfit of both depths."""
    if not refinement.accepted:
        return {}
    T_cam_world, K = (torch.from_numpy(value).double()[None] for value in (refinement.T_cam_world, refinement.K))
    second = predict(model, read_photos(model, scene.photos), priors=Priors(T_cam_world=T_cam_world, K=K))
    score = evaluate(bring_depth(second, refinement)[0], scene)["f1_rel5"]
    return {"second_f1_rel5": score, "misfit": [depth_misfit(one, refinement) for one in (frozen, second)]}


def _accepted(refinement: Refinement) -> Refinement:
    """The same without the rule of acceptance, to see what the rule costs and saves."""
    return replace(refinement, accepted=refinement.T_cam_world is not None)


def _told(refinement: Refinement, matches: Matches) -> dict:
    return {
        "accepted": refinement.accepted,
        "reason": refinement.reason,
        "pairs": len(matches.pairs),
        "tracks": 0 if refinement.tracks is None else len(refinement.tracks),
        "probability": refinement.probability,
        "depth_spread": refinement.depth_spread,
    }


def _line(row: dict) -> str:
    change = " ".join(f"{name} {row['before'][name]:.3f}>{row['after'][name]:.3f}" for name in ("auc15", "f1_rel5"))
    raw = f"(unjudged {row['unjudged']['auc15']:.3f})"
    return f"{row['domain']} {row['seed']} {change} {raw} {row['pairs']} pairs {row['refine_s']:.1f} s: {row['reason']}"


def room_table(rows: list[dict]) -> str:
    """Mean before, mean change with its interval, and the worst room, for each domain."""
    names = ("AUC@5", "AUC@15", "AUC@30", "F1 (5 %)", "abs-rel")
    lines = []
    for kind in ("after", "unjudged", "affine"):
        for domain in in_order(row["domain"] for row in rows):
            own = [row for row in rows if row["domain"] == domain]
            cells = []
            for score in SCORES:
                start = float(np.mean([row["before"][score] for row in own]))
                cells.append(f"{plain(start)} {change([row[kind][score] - row['before'][score] for row in own])}")
            accepted = sum(row["accepted"] for row in own)
            seconds = np.mean([row["refine_s"] for row in own])
            name = domain if kind == "after" else f"{domain} ({kind})"
            lines.append([name, f"{accepted} of {len(own)}", *cells, f"{seconds:.1f}"])
    return table(("rooms", "accepted", *names, "CPU s"), lines)


def report(folder: Path) -> None:
    """Print the tables of docs/refinement.md."""
    records = [json.loads(file.read_text(encoding="utf-8")) for file in sorted(folder.rglob("*.json"))]
    for views in sorted({record["settings"]["views"] for record in records}):
        rows = [row for one in records if one["settings"]["views"] == views for row in one["results"]["rows"]]
        print(f"{views} photos; `unjudged`: whatever bundle adjustment ends with; `affine`: with `affine=True`\n")
        print(f"{room_table(rows)}\n")
        print(f"{second_line([row for row in rows if row['accepted']])}\n")


def second_line(rows: list[dict]) -> str:
    """What the second prediction, told the refined cameras, is worth in accepted rooms."""
    if not rows:
        return "No room was accepted."
    first = np.array([row["after"]["f1_rel5"] for row in rows])
    second = np.array([row["second_f1_rel5"] for row in rows])
    taken = np.array([row["misfit"][1] < row["misfit"][0] for row in rows])
    means = [plain(float(values.mean())) for values in (first, second, np.where(taken, second, first))]
    return (
        f"{len(rows)} accepted rooms, second prediction taken in {taken.sum()}: F1 (5 %) {means[0]} with the first, "
        f"{means[1]} with the second, {means[2]} with the one that is taken"
    )


def photos(arguments: argparse.Namespace) -> list[dict]:
    """Measure folders of real photos with true cameras; one row for each folder and seed."""
    rows = []
    for folder in map(Path, arguments.folders):
        images, truth, K = known_photos(folder)
        started = time.process_time()
        matches = find_matches(images)
        matched = time.process_time() - started
        for seed in range(arguments.seeds):
            wrong = perturbed(truth, arguments.degrees, seed)
            prediction = _prediction(images, matches, wrong, K, 1 + arguments.focal * (-1) ** seed, truth)
            started = time.process_time()
            refinement = refine(prediction, matches)
            seconds = time.process_time() - started
            row = {"scene": folder.name, "seed": seed, "views": len(images), "match_s": matched, "refine_s": seconds}
            row |= _told(refinement, matches) | {"before": _errors(wrong, truth)}
            row["parallax_px"] = parallax_px(Candidate.of(prediction), matches)
            if refinement.T_cam_world is not None:
                row["after"] = _errors(torch.from_numpy(refinement.T_cam_world), truth)
                row["focal"] = float(np.median(refinement.photo_K[:, 0, 0] / K[:, 0, 0].numpy()))
            rows.append(row)
            print(json.dumps(row), flush=True)
    return rows


def known_photos(folder: Path) -> tuple[list[PhotoLike], torch.Tensor, torch.Tensor]:
    """Photos of a folder with `cameras.json`, and their true `T_cam_world` (S, 4, 4) and `K` (S, 3, 3)."""
    frames = json.loads((folder / "cameras.json").read_text())["frames"]
    images = load_photos([str(folder / "images" / frame["name"]) for frame in frames], len(frames))
    K, truth = (torch.tensor([frame[key] for frame in frames], dtype=torch.float64) for key in ("K", "w2c"))
    # Six printed digits are not quite a rotation, which the pose score takes for an error of zero.
    U, _, Vh = torch.linalg.svd(truth[:, :3, :3])
    truth[:, :3, :3] = U @ Vh
    return images, truth, K


def perturbed(T_cam_world: torch.Tensor, degrees: float, seed: int, growth: float = 0.1) -> torch.Tensor:
    """Cameras (S, 4, 4) with errors that hang together.

    The path bends about one axis, and every camera is turned a third as far on its own; together the median error of
    the relative rotations of all pairs is `degrees`. Steps grow steadily, from 1 - `growth` to 1 + `growth`.
    """
    if degrees == 0:
        return T_cam_world.clone()
    generator = np.random.default_rng(seed)
    count = len(T_cam_world)
    along = torch.linspace(-1, 1, count, dtype=torch.float64)
    axis = generator.normal(size=3)
    own = generator.normal(size=(count, 3))
    own *= 1 / 3 / np.linalg.norm(own, axis=1, keepdims=True)
    turns = along[:, None] * torch.from_numpy(axis / np.linalg.norm(axis)) + torch.from_numpy(own)
    R = T_cam_world[:, :3, :3]
    for _ in range(3):  # the median angle is nearly, but not quite, proportional
        bent = _rotations(turns * np.deg2rad(degrees))
        turned = T_cam_world.clone()
        turned[:, :3, :3] = bent.mT @ R
        turns = turns * degrees / pair_errors(turned, T_cam_world).rotation_deg.median()
    bent = _rotations(turns * np.deg2rad(degrees))
    centres = -(R.mT @ T_cam_world[:, :3, 3:])[..., 0]
    steps = (centres[1:] - centres[:-1]) * torch.linspace(1 - growth, 1 + growth, count - 1, dtype=torch.float64)[
        :, None
    ]
    # A bent path: each step is turned with the camera that it starts from.
    world = R.mT @ bent @ R
    moved = torch.cat((centres[:1], centres[:1] + torch.cumsum((world[:-1] @ steps[..., None])[..., 0], dim=0)))
    wrong = T_cam_world.clone()
    wrong[:, :3, :3] = bent.mT @ R
    wrong[:, :3, 3] = -(wrong[:, :3, :3] @ moved[..., None])[..., 0]
    return wrong


def _rotations(vectors: torch.Tensor) -> torch.Tensor:
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.matrix_exp(torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3)))


def _prediction(images, matches: Matches, T: torch.Tensor, K: torch.Tensor, focal: float, truth: torch.Tensor):
    """A reconstruction with these cameras; its depth is one number for each view, that of the true points."""
    exact = with_cameras(images, matches, truth, K)
    depth = np.ones_like(exact.depth_z)
    for view, (_, z) in enumerate(true_points(exact, matches, truth)):
        depth[view] = np.nanmedian(z) if np.isfinite(z).any() else 1.0
    assert valid_depth(torch.from_numpy(depth)).all()
    return with_errors(exact, T, focal, depth)


def with_cameras(images, matches: Matches, T: torch.Tensor, K: torch.Tensor, image_hw=(48, 64)) -> Reconstruction:
    """A reconstruction with given cameras, K in pixels of the photos, and depth 1."""
    height, width = image_hw
    scale = np.array([width, height]) / matches.photo_hw[:, ::-1]
    model_K = K.numpy().copy()
    # Resizing keeps corners in place.
    model_K[:, :2, 2] += 0.5
    model_K[:, :2] *= scale[:, :, None]
    model_K[:, :2, 2] -= 0.5
    return Reconstruction(
        depth_z=np.ones((len(T), height, width), np.float32),
        conf=np.ones((len(T), height, width), np.float32),
        images=np.zeros((len(T), height, width, 3), np.uint8),
        names=tuple(photo.name for photo in images),
        photo_hw=matches.photo_hw,
        scale_xy=scale,
        offset_xy=np.zeros((len(T), 2)),
        T_cam_world=T.numpy().astype(np.float32),
        K=model_K.astype(np.float32),
    )


def with_errors(exact: Reconstruction, T: torch.Tensor, focal: float, depth_z: np.ndarray) -> Reconstruction:
    """The same with other cameras, focal lengths and depth."""
    K = exact.K.copy()
    K[:, (0, 1), (0, 1)] *= focal
    return replace(
        exact, depth_z=depth_z.astype(np.float32), T_cam_world=T.numpy().astype(np.float32), K=K.astype(np.float32)
    )


def true_points(exact: Reconstruction, matches: Matches, truth: torch.Tensor) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each view the photo pixels (n, 2) and the depth (n,) of the tracks that it shows, by the true cameras."""
    tracks = join_matches(matches)
    seen = triangulate(Candidate.of(exact), matches, tracks)
    found = []
    for view in range(len(truth)):
        rows = tracks.view == view
        z = seen.xyz[tracks.point[rows]] @ truth[view, 2, :3].numpy() + float(truth[view, 2, 3])
        found.append((tracks.pixel[rows], z))
    return found


def _errors(T: torch.Tensor, truth: torch.Tensor) -> dict[str, float]:
    errors = pair_errors(T.double(), truth)
    medians = {
        "rotation_deg": float(errors.rotation_deg.median()),
        "translation_deg": float(errors.translation_deg.median()),
        "worst_deg": float(errors.worst_deg.median()),
    }
    return {**medians, **pose_auc(errors.worst_deg)}


def photo_table(rows: list[dict]) -> str:
    """One line for each folder: medians over the seeds."""
    lines = [
        "| scene | views | accepted | rotation | translation | ratio | focal | match s | refine s |",
        "|---" * 9 + "|",
    ]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        own = [row for row in rows if row["scene"] == scene and "after" in row]
        total = [row for row in rows if row["scene"] == scene]
        if not own:
            lines.append(f"| {scene} | {total[0]['views']} | 0 of {len(total)} |" + " |" * 6)
            continue

        def middle(key: str, when: str, own: list[dict] = own) -> float:
            return float(np.median([row[when][key] for row in own]))

        ratio = np.median([row["after"]["worst_deg"] / row["before"]["worst_deg"] for row in own])
        lines.append(
            f"| {scene} | {own[0]['views']} | {sum(row['accepted'] for row in own)} of {len(total)} "
            f"| {middle('rotation_deg', 'before'):.2f} > {middle('rotation_deg', 'after'):.3f} "
            f"| {middle('translation_deg', 'before'):.2f} > {middle('translation_deg', 'after'):.3f} | {ratio:.3f} "
            f"| {np.median([row['focal'] for row in own]):.4f} | {own[0]['match_s']:.1f} "
            f"| {np.median([row['refine_s'] for row in own]):.1f} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    kinds = parser.add_subparsers(dest="kind", required=True)
    room = kinds.add_parser("rooms")
    room.add_argument("--domains", default=DOMAINS)
    room.add_argument("--rooms", type=int, default=8)
    room.add_argument("--first", type=int, default=0)
    room.add_argument("--views", type=int, default=8)
    photo = kinds.add_parser("photos")
    photo.add_argument("folders", nargs="+")
    photo.add_argument("--degrees", type=float, default=2.0)
    photo.add_argument("--focal", type=float, default=0.02)
    photo.add_argument("--seeds", type=int, default=4)
    for kind in (room, photo):
        kind.add_argument("--out", type=Path)
    kinds.add_parser("report").add_argument("folder", type=Path)
    arguments = parser.parse_args()
    if arguments.kind == "report":
        report(arguments.folder)
        return
    torch.set_num_threads(1)
    rows = rooms(arguments) if arguments.kind == "rooms" else photos(arguments)
    print(room_table(rows) if arguments.kind == "rooms" else photo_table(rows))
    if arguments.out:
        settings = {name: value for name, value in vars(arguments).items() if name not in ("out", "folders")}
        packages = ("torch", "numpy", "opencv-python-headless", "pycolmap")
        write_result(arguments.out, settings=settings, results={"rows": rows}, packages=packages)


if __name__ == "__main__":
    main()
