"""Long sequences: accuracy, memory and robustness on a generated walk that comes back to its start.

Run: python benchmarks/sequences.py PART [--frames 300] [--first N] [--seed 20000000] [--alike] [--refine]
    [--work FOLDER]

`chunks`: what the embedded model does with chunks of several sizes, each alone: errors of cameras and depth.
`exact`:  true depth and cameras; each chunk in its own random similarity frame, with noise and outliers. How far the
          seams and the graph are from the truth, without a loop, with a true one, and with a false one.
`walk`:   error of the whole trajectory by chunk size, overlap and loops; with --refine, of chunks that are refined by
          matches (docs/refinement.md), with half of a chunk shared. With --first, of the first N frames only, with half
          of a chunk shared.
`poses`:  error of the first 60 frames (--first) in chunks of 12 when true poses of 0, 3, 6 and 12 of them are known,
          evenly spread, with one of twelve wrong, and of 6 pairs of neighbours.
`memory`: peak memory of a fresh process against the number of frames, with a figure.
`film`:   writes a walk as a video (--out FILE.mp4), by default of 1,000 frames.
`video`:  time and peak memory of a video of 1,000 frames.
`kill`:   a run that is killed at random moments until it ends by itself, against one that is not.
`report`: the tables of all files in a folder (--out FOLDER).

What is rendered is kept in --work, and so are finished runs: a part that is started again goes on where it stopped.
Runs are `freegeo reconstruct` in processes of their own.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from record import write_result

from freegeo.data.procedural import Walk, walk
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.rotation import rotation_angle
from freegeo.geometry.se3 import camera_centres
from freegeo.geometry.sim3 import Sim3, align_cameras
from freegeo.metrics.pose import pair_errors, pose_auc
from freegeo.models.da3_config import embedded_spec
from freegeo.training.pool import image_size

DOMAIN = "test-id"
MODEL_HW = image_size(embedded_spec().default_side, (3, 4), embedded_spec().patch_size)
ALL_FRAMES = {
    "walk": 300,
    "poses": 300,
    "memory": 300,
    "exact": 300,
    "chunks": 300,
    "film": 1000,
    "video": 1000,
    "kill": 300,
}
KILLS = 6
DELIVERED = (0, 3)
"""Exit codes with a result; 3: in pieces."""


def chunks(arguments: argparse.Namespace) -> list[dict]:
    """Score single chunks of consecutive frames, and of every second and third one."""
    import freegeo
    from freegeo.models.images import read_photos
    from freegeo.pipeline import predict

    model = freegeo.load_model("freegeo-tiny")
    around = small(walk(arguments.seed, DOMAIN, arguments.frames))
    rows = []
    for stride in (1, 2, 3):
        for size in (8, 12, 16, 24, 32, 48):
            found = []
            for start in np.linspace(0, arguments.frames - (size - 1) * stride - 1, 5).astype(int):
                scene = around.scene(range(start, start + (size - 1) * stride + 1, stride))
                found.append(chunk_scores(predict(model, read_photos(model, scene.photos)), scene))
            row = {"size": size, "stride": stride} | {key: mean(one[key] for one in found) for key in found[0]}
            row["scale_spread"] = float(np.std([one["log_scale"] for one in found]))
            del row["log_scale"]
            rows.append(row)
    return rows


def small(around: Walk) -> Walk:
    """The walk with photos of the size that the embedded model reads."""
    return replace(around, photo_hw=MODEL_HW)


def mean(values) -> float:
    return float(np.mean(list(values)))


def chunk_scores(result: Reconstruction, scene) -> dict[str, float]:
    """Errors of one chunk; `path` is the error of the positions after one alignment, relative to the way walked."""
    T = torch.from_numpy(np.asarray(result.T_cam_world)).double()
    errors = pair_errors(T, scene.T_cam_world.double())
    error, sim3 = trajectory_error(T, scene.T_cam_world)
    depth, true = torch.from_numpy(np.asarray(result.depth_z)), scene.depth_z
    scale = (true / depth).median()
    return {
        "rotation_deg": float(errors.rotation_deg.median()),
        "translation_deg": float(errors.translation_deg.median()),
        "auc30": pose_auc(errors.worst_deg, (30,))["auc30"],
        "path": error,
        "abs_rel": float(((depth * scale - true).abs() / true).mean()),
        "log_scale": float(np.log(float(scale) / float(sim3.s))),
    }


def trajectory_error(T_cam_world: torch.Tensor, truth: torch.Tensor) -> tuple[float, Sim3]:
    """Root mean square of the distances of the positions after one alignment of all, relative to the way walked."""
    aligned = align_cameras(truth.double(), T_cam_world.double(), ransac=False)
    true = camera_centres(truth.double())
    off = (camera_centres(aligned.T_cam_world) - true).square().sum(-1).mean().sqrt()
    return float(off / true.diff(dim=0).norm(dim=-1).sum()), aligned.sim3


def exact(arguments: argparse.Namespace) -> list[dict]:
    """Align true chunks that were moved, turned, scaled and disturbed."""
    from freegeo.sequence.assembly import assemble, seams_between
    from freegeo.sequence.chunks import Chunk, plan_chunks

    around = small(walk(arguments.seed, DOMAIN, arguments.frames))
    scene = around.scene()
    rows = []
    size, half = 24, 12
    last = len(scene) - 1
    ends = {
        "none": None,
        "true": (*range(half), *range(last - half + 1, last + 1)),
        # Two places that are far apart and are taken for one.
        "false": (*range(last // 4, last // 4 + half), *range(3 * last // 4, 3 * last // 4 + half)),
    }
    for noise, outliers in ((0.0, 0.0), (0.01, 0.0), (0.01, 0.1), (0.02, 0.3)):
        for loop, frames in ends.items():
            plan = plan_chunks(len(scene), size, half)
            parts = [moved_chunk(scene, chunk.frames, noise, outliers, number) for number, chunk in enumerate(plan)]
            if frames is not None:
                plan = [*plan, Chunk(frames=frames, tie="loop")]
                parts.append(moved_chunk(scene, frames, noise, outliers, len(parts), merged=loop == "false"))
            began = time.perf_counter()
            found = assemble(plan, seams_between(plan, parts.__getitem__), parts.__getitem__)
            seconds = time.perf_counter() - began
            ties = [joint for joint in found.joints if joint.kind == "loop"]
            rows.append({
                "noise": noise, "outliers": outliers, "loop": loop, "pieces": len(found.pieces),
                "loop_used": all(joint.reason is None for joint in ties) if ties else None,
                **chain_errors(scene, plan, parts, found), "seconds": seconds,
            })  # fmt: skip
    return rows


def chain_errors(scene, plan, parts, found) -> dict[str, float | None]:
    """Errors of the positions of all chunks, relative to the scene's radius; None where they are in pieces."""
    if len(found.pieces) > 1:
        return {"rms": None, "worst": None}
    true = camera_centres(scene.T_cam_world.double())
    extent = float((true - true.mean(0)).norm(dim=-1).max())
    # The first chunk stays, so its own frame is the only freedom; it is found from its own cameras.
    own = align_cameras(
        scene.T_cam_world[list(plan[0].frames)].double(), torch.from_numpy(parts[0].T_cam_world).double(), ransac=False
    ).sim3
    off = []
    for chunk, part, sim3 in zip(plan, parts, found.sim3, strict=True):
        if chunk.tie is None:
            T = sim3.to(torch.float64).apply_to_cameras(torch.from_numpy(part.T_cam_world).double())
            off.append((own.apply(camera_centres(T)) - true[list(chunk.frames)]).norm(dim=-1))
    distance = torch.cat(off) / extent
    return {"rms": float(distance.square().mean().sqrt()), "worst": float(distance.max())}


def moved_chunk(
    scene, frames: tuple[int, ...], noise: float, outliers: float, seed: int, *, merged: bool = False
) -> Reconstruction:
    """The truth of some frames in a random similarity frame, with relative noise and a share of wrong depths.

    `merged`: the second half of the frames stands where the first one does, as if both showed one place.
    """
    rng = np.random.default_rng(seed)
    views = list(frames)
    turn = torch.linalg.qr(torch.from_numpy(rng.normal(size=(3, 3)))).Q
    sim3 = Sim3(
        s=torch.tensor(float(np.exp(rng.normal(0, 0.5))), dtype=torch.float64),
        R=turn * torch.linalg.det(turn).sign(),
        t=torch.from_numpy(rng.normal(0, 5, size=3)),
    )
    cameras = scene.T_cam_world[views].double()
    if merged:
        half = len(views) // 2
        cameras[half:] = cameras[half:] @ torch.linalg.inv(cameras[half]) @ cameras[0]
    depth = scene.depth_z[views].double().numpy() * float(sim3.s)
    depth *= 1 + noise * rng.normal(size=depth.shape)
    wrong = rng.random(depth.shape) < outliers
    depth[wrong] *= np.exp(rng.normal(0, 0.5, size=int(wrong.sum())))
    count = len(views)
    return Reconstruction(
        depth_z=depth.astype(np.float32),
        conf=np.ones_like(depth, dtype=np.float32),
        images=np.stack([scene.photos[i].read() for i in views]),
        names=tuple(scene.photos[i].name for i in views),
        photo_hw=np.array([scene.photos[0].size_hw] * count),
        scale_xy=np.ones((count, 2)),
        offset_xy=np.zeros((count, 2)),
        T_cam_world=sim3.apply_to_cameras(cameras).numpy().astype(np.float32),
        K=scene.K[views].numpy().astype(np.float32),
    )


def whole_walk(arguments: argparse.Namespace) -> list[dict]:
    """Reconstruct the walk with several plans."""
    around = walk(arguments.seed, DOMAIN, arguments.frames, alike=arguments.alike)
    kind = "alike" if arguments.alike else "plain"
    folder = f"photos-{kind}-{arguments.seed}-{arguments.first or arguments.frames}"
    photos = written_photos(around, arguments.work / folder, arguments.first)
    rows = []
    more = ["--refine", "ba"] if arguments.refine else []
    for size in (8, 12, 16):
        for overlap in (size // 2,) if arguments.refine or arguments.first else (size // 2, size // 4):
            for loops in (True, False):
                name = f"{photos.name}-{size}-{overlap}-{'loops' if loops else 'no-loops'}"
                out = photos.parent / (f"{name}-refined" if arguments.refine else name)
                plan = ["--chunk", str(size), "--overlap", str(overlap), "--loops" if loops else "--no-loops"]
                run([*plan, "--order", "given", *more], photos, out)
                row = {"chunk": size, "overlap": overlap, "loops": loops} | walk_scores(out, around)
                rows.append(row)
                print(json.dumps(row), flush=True)
    return rows


def walk_scores(out: Path, around: Walk) -> dict:
    """Errors of a finished run, over the frames of its first piece."""
    told = json.loads((out / "reconstruction.json").read_text())["sequence"]
    result = Reconstruction.load(out)
    frames = [int(Path(name).stem) for name in result.names]
    error, _ = trajectory_error(torch.from_numpy(np.array(result.T_cam_world)), around.T_cam_world[frames])
    return {
        "error": error,
        "frames": len(frames),
        "pieces": len(told["pieces"]),
        "seams_left_out": sum(not seam["used"] for seam in told["seams"]),
        "doubtful": sum(seam["used"] and bool(seam["reason"]) for seam in told["seams"]),
        "loops_used": sum(loop["used"] for loop in told["loops"]),
        "loops_refused": sum(not loop["used"] for loop in told["loops"]),
    }


def known_poses(arguments: argparse.Namespace) -> list[dict]:
    """Reconstruct the first frames of the walk with known poses of some; the predictions are the same for all."""
    around, count = walk(arguments.seed, DOMAIN, arguments.frames), arguments.first or 60
    photos = written_photos(around, arguments.work / f"photos-plain-{arguments.seed}-{count}", count)
    out, rows = arguments.work / f"{photos.name}-poses", []
    spread = {n: np.linspace(0, count - 1, n + 2)[1:-1].round().astype(int).tolist() for n in (3, 6, 12)}
    wrong = spread[12][5]
    pairs = sorted({frame + step for frame in spread[6] for step in (0, 1)})
    for name, frames in {"none": [], **spread, "12, one wrong": spread[12], "6 pairs of neighbours": pairs}.items():
        more = []
        if frames:
            cameras = arguments.work / f"{photos.name}.json"
            shown = {frame: spread[12][0] if name == "12, one wrong" and frame == wrong else frame for frame in frames}
            write_poses(cameras, around, shown)
            more = ["--cameras", str(cameras), "--trust-cameras"]
        plan = ["--chunk", "12", "--overlap", "6", "--order", "given", "--formats", "npz"]
        process = subprocess.run(command([*plan, *more], photos, out), check=False)
        if process.returncode not in DELIVERED:
            raise SystemExit(f"{out}: freegeo ended with {process.returncode}")
        rows.append({"poses": name} | posed_scores(out, around, frames))
        print(json.dumps(rows[-1]), flush=True)
    return rows


def write_poses(path: Path, around: Walk, shown: dict[int, int]) -> None:
    """Write the true poses of some photos, each that of the frame it is said to have."""
    known = [
        {"name": around.photos[frame].name, "w2c": around.T_cam_world[given].double().tolist()}
        for frame, given in shown.items()
    ]
    path.write_text(json.dumps({"frames": known}))


def posed_scores(out: Path, around: Walk, frames: list[int]) -> dict:
    """Errors of the frames without a known pose, in the frame and scale of the known ones where there are some.

    Positions relative to the way, as `walk_scores` has them of all frames after one alignment, and angles.
    """
    about = json.loads((out / "reconstruction.json").read_text())
    result = Reconstruction.load(out)
    views = [int(Path(name).stem) for name in result.names]
    truth, T = around.T_cam_world[views].double(), torch.from_numpy(np.array(result.T_cam_world)).double()
    way = float(camera_centres(truth).diff(dim=0).norm(dim=-1).sum())
    known = about["known_cameras"] or {}
    free = [row for row, view in enumerate(views) if view not in frames or not known.get("poses")]
    row = {"frames": len(views), "pieces": len(about["sequence"]["pieces"]), "aligned": trajectory_error(T, truth)[0]}
    if known.get("poses"):
        off = (camera_centres(T) - camera_centres(truth))[free]
        turned = rotation_angle(T[free, :3, :3], truth[free, :3, :3])
        row |= {"in_world": float(off.square().sum(-1).mean().sqrt()) / way, "turned": float(turned.median().rad2deg())}
        row |= {"residual_deg": known["rotation_deg"], "residual": known["position"]}
        row |= {"untied": f"{known['untied']} of {known['chunks']}", "odd": len(known["odd"])}
    return row


def written_photos(around: Walk, folder: Path, count: int | None = None) -> Path:
    """Write the first frames of a walk as PNG files; those that are there are kept."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    for photo in around.photos[:count]:
        if not (folder / photo.name).exists():
            part = folder / f".{photo.name}"
            Image.fromarray(photo.read()).save(part, format="PNG")
            part.replace(folder / photo.name)
    return folder


def command(settings: list[str], source: Path, out: Path) -> list[str]:
    base = [sys.executable, "-m", "freegeo.cli.app", "reconstruct", str(source), "--model", "freegeo-tiny"]
    return [*base, *settings, "-o", str(out)]


def run(settings: list[str], source: Path, out: Path) -> dict[str, float]:
    """Run `freegeo reconstruct`, unless it is finished, and return its time and peak memory."""
    noted = out.parent / f"{out.name}.json"
    if noted.exists():
        return json.loads(noted.read_text())
    began = time.perf_counter()
    process = subprocess.Popen(command(settings, source, out))
    _, status, usage = os.wait4(process.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    if code not in DELIVERED:
        raise SystemExit(f"{out}: freegeo ended with {code}")
    row = {"exit": code, "seconds": time.perf_counter() - began, "peak_mb": usage.ru_maxrss / 1024}
    noted.write_text(json.dumps(row))
    return row


def memory(arguments: argparse.Namespace) -> list[dict]:
    """Measure the peak memory of the first frames of the walk."""
    around = walk(arguments.seed, DOMAIN, arguments.frames)
    rows = []
    for count in (16, 50, 100, 200, 300):
        if count <= arguments.frames:
            photos = written_photos(around, arguments.work / f"first-{count}", count)
            row = {"frames": count} | run(["--chunk", "16"], photos, arguments.work / f"memory-{count}")
            rows.append(row)
    draw(rows, arguments.work / "sequence-memory.png")
    return rows


def draw(rows: list[dict], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(5, 3.2), layout="constrained")
    axes.plot([row["frames"] for row in rows], [row["peak_mb"] for row in rows], marker="o")
    axes.set(xlabel="frames", ylabel="peak memory (MB)", ylim=(0, None))
    figure.savefig(path, dpi=120)


def film(arguments: argparse.Namespace) -> Path:
    """Write a walk as a video at 25 frames a second; the file appears when it is whole."""
    import av

    path = arguments.out if arguments.part == "film" and arguments.out else arguments.work / "walk.mp4"
    if path.exists():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    around = walk(arguments.seed, DOMAIN, arguments.frames)
    part = path.with_name(f".{path.name}")
    with av.open(str(part), "w", format="mp4") as container:
        stream = container.add_stream("h264", rate=25)
        stream.height, stream.width = around.photo_hw
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "18"}
        for photo in around.photos:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(photo.read(), format="rgb24")))
        container.mux(stream.encode(None))
    part.replace(path)
    return path


def video(arguments: argparse.Namespace) -> list[dict]:
    """Reconstruct a long video."""
    path = film(arguments)
    most = ["--max-views", str(arguments.frames), "--fps", "25"]
    out = arguments.work / "video"
    row = run(most, path, out)
    told = json.loads((out / "reconstruction.json").read_text())["sequence"]
    return [{"frames": told["frames"], "chunk": told["chunk"], "pieces": len(told["pieces"])} | row]


def kill(arguments: argparse.Namespace) -> list[dict]:
    """Kill a run at random moments and start it again until it ends; its result equals that of a run left alone."""
    photos = written_photos(walk(arguments.seed, DOMAIN, arguments.frames), arguments.work / "photos-plain")
    plan = ["--chunk", "16"]
    whole = run(plan, photos, arguments.work / "whole")
    out, dice = arguments.work / "killed", random.Random(0)
    rows = []
    for number in range(KILLS + 1):
        began = time.perf_counter()
        process = subprocess.Popen(command(plan, photos, out))
        try:
            limit = None if number == KILLS else dice.uniform(0.1, 0.6) * whole["seconds"]
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            code = process.wait()
        chunks_there = len(list((out / "chunks").glob("*/prediction.npz")))
        rows.append({"seconds": time.perf_counter() - began, "exit": code, "chunks": chunks_there})
        if code in DELIVERED:
            break
    one, two = (Reconstruction.load(arguments.work / name) for name in ("whole", "killed"))
    rows[-1]["equal"] = all(
        np.array_equal(np.asarray(getattr(one, name)), np.asarray(getattr(two, name)))
        for name in ("depth_z", "conf", "T_cam_world", "K")
    )
    return rows


PARTS = {
    "chunks": chunks,
    "exact": exact,
    "walk": whole_walk,
    "poses": known_poses,
    "memory": memory,
    "video": video,
    "kill": kill,
}


def table(rows: list[dict]) -> str:
    """The rows as a table in Markdown."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    lines = ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
    for row in rows:
        values = (row.get(name, "") for name in names)
        cells = (f"{value:.4g}" if isinstance(value, float) else str(value) for value in values)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


HEADINGS = {
    "size": "frames", "stride": "step", "rotation_deg": "rotation", "translation_deg": "translation", "auc30": "AUC@30",
    "abs_rel": "abs-rel", "scale_spread": "scale", "outliers": "wrong depths", "noise": "noise of depth",
}  # fmt: skip


def report(folder: Path) -> None:
    """Print the rows of every file as a table."""
    for file in sorted(folder.glob("*.json")):
        record = json.loads(file.read_text(encoding="utf-8"))
        rows = [{HEADINGS.get(k, k): v for k, v in row.items()} for row in record["results"]["rows"]]
        print(f"{file.stem}, {record['settings']}\n\n{table(rows)}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=[*PARTS, "film", "report"])
    parser.add_argument("--frames", type=int, help="of the walk")
    parser.add_argument("--first", type=int, help="walk, poses: reconstruct only so many frames, the first ones")
    parser.add_argument("--seed", type=int, default=20_000_000)
    parser.add_argument("--alike", action="store_true", help="walk: two rooms look alike")
    parser.add_argument("--refine", action="store_true", help="walk: refine chunks by matches")
    parser.add_argument("--work", type=Path, default=Path("sequences-work"))
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    if arguments.part == "report":
        report(arguments.out)
        return
    arguments.frames = arguments.frames or ALL_FRAMES[arguments.part]
    torch.set_num_threads(1)
    if arguments.part == "film":
        print(film(arguments))
        return
    rows = PARTS[arguments.part](arguments)
    print(table(rows))
    kind = "".join(f"-{name}" for name in ("alike", "refine") if getattr(arguments, name))
    name = f"sequence-{arguments.part}{kind}.json"
    path = arguments.out or Path(__file__).parent / "results" / name
    settings = {name: getattr(arguments, name) for name in ("frames", "seed", "alike", "refine")}
    write_result(path, settings=settings, results={"rows": rows}, show=False)


if __name__ == "__main__":
    main()
