"""Everything that freegeo reads: how a file of a kind is written, and what is done with it."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from PIL import Image

from bench_tools import ROOMS, small_room, store_truth, task
from exact_rooms import room
from example_results import write_example
from fixture_tools import fixture_path
from freegeo import files
from freegeo.adaptation.adapter_files import export_published, load_adapter, save_adapter
from freegeo.adaptation.state import UNFINISHED_FILE, read_state, write_state
from freegeo.benchmark import score
from freegeo.benchmark.results import read_results
from freegeo.benchmark.score import evaluate_all
from freegeo.benchmark.stored import read_stored
from freegeo.benchmark.tasks import DAMAGED
from freegeo.cameras.reading import read_camera_file, read_cameras
from freegeo.cli import demo
from freegeo.cli.app import checked_config, main
from freegeo.cli.batch import stored_rows
from freegeo.data.datasets import registry
from freegeo.data.masks import load_masks as read_masks
from freegeo.data.photos import MemoryPhoto, load_photos
from freegeo.data.procedural import splits
from freegeo.data.video import load_video
from freegeo.errors import FreeGeoError
from freegeo.evidence.matches import VERSION, load_matches
from freegeo.export.formats import filter_reconstruction
from freegeo.export.kept import load_kept, load_masks, save_kept
from freegeo.export.measured import load_tracks, save_tracks
from freegeo.fusion.tracks import Tracks
from freegeo.models.checkpoints import fingerprint, load_weights, require_fit, save_weights
from freegeo.models.da3_config import KEYS
from freegeo.report import figures
from freegeo.report.overview import SceneRow, write_overview
from freegeo.report.page import write_report
from freegeo.run_folder import run_folder
from freegeo.training.curve import read_log
from tiny_models import tiny_da3, trained

VIEWS, SIZE = 3, (12, 16)
HIROOM = "20241230/828805/cam_sampled_06"
DATASETS = fixture_path("benchmark", "datasets")


@dataclass(frozen=True)
class Reader:
    """A kind of file."""

    name: str
    write: Callable[[Path], Path]
    """Make a sound file, and what belongs to it, in a new folder; returns the file's path."""
    read: Callable[[Path], object]
    """Read the file, and use what it says."""


def _command(*arguments: object) -> None:
    """Run a command; its sentence becomes an error, as a reader's."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        code = main([str(argument) for argument in arguments])
    if code:
        raise FreeGeoError(said.getvalue().strip().splitlines()[-1])


def _result(folder: Path) -> Path:
    """Return a small finished result, with everything that belongs to one."""
    scene = room(VIEWS, SIZE)
    with run_folder(folder, {"command": "reconstruct"}) as run:
        scene.save(folder)
        filtered = filter_reconstruction(scene)
        save_kept(folder, filtered, np.ones(scene.depth_z.shape, bool))
        files.write_json(
            folder / "reconstruction.json",
            {"images": list(scene.names), "photo_files": [None] * VIEWS, "refinement": None, "warnings": ["w"]},
        )
        run.finish()
    return folder


def _of_result(name: str) -> Callable[[Path], Path]:
    return lambda folder: _result(folder) / name


def _export(file: Path) -> None:
    _command("export", file.parent, "-f", "ply,depth,nerfstudio", "-o", file.parent.parent / "exported")


def _tracks(folder: Path) -> Path:
    _result(folder)
    return save_tracks(folder, Tracks(
        xyz=np.ones((2, 3)), colours=np.zeros((2, 3), np.uint8), point=np.array([0, 0, 1, 1]),
        view=np.array([0, 1, 0, 1]), pixel=np.ones((4, 2)),
    ))  # fmt: skip


def _matches(folder: Path) -> Path:
    folder.mkdir(parents=True)
    views, pairs = np.array([[0, 1], [0, 2]]), np.array([0, 1, 2])
    np.savez(
        folder / "matches.npz", format=VERSION, names=["a", "b", "c"], fingerprint="x", photo_hw=np.full((3, 2), 20),
        match_hw=np.full((3, 2), 10), keypoints=np.ones((6, 2)), view_start=np.array([0, 2, 4, 6]), pairs=views,
        pair_start=pairs, ends=np.array([[0, 2], [1, 4]]), flatness=np.zeros(2), tried=views,
        outcome=np.zeros(2, int), candidates=np.ones(2, int),
    )  # fmt: skip
    return folder / "matches.npz"


def _use_matches(file: Path) -> None:
    found = load_matches(file)
    if found is not None:
        for view, (start, end) in enumerate(zip(found.view_start[:-1], found.view_start[1:], strict=True)):
            assert len(found.keypoints[start:end]) == end - start, view
        assert len(found.pair_start) == len(found.pairs) + 1
        assert found.keypoints[found.ends].shape == (len(found.ends), 2, 2)
        assert np.isfinite(found.keypoints).all()


def _example(name: str) -> Callable[[Path], Path]:
    return lambda folder: write_example(folder, views=2, hw=SIZE) / name


def _summary(folder: Path) -> Path:
    """Return a reconstruction.json in which everything that is shown somewhere has a value."""
    path = write_example(folder, views=2, hw=SIZE) / "reconstruction.json"
    scores = {
        "epipolar_px": 1.0, "reprojection_px": 1.0, "depth_agreement": 0.5, "depth_agreement_frozen": 0.6, "matches": 9,
    }  # fmt: skip
    trial = {"steps": 1.0, "strength": 1.0, **scores, "probability": 0.9}
    seam = {"first": 0, "second": 1, "kind": "neighbours", "used": True, "frames": 1, "inliers": 0.5, "rms": 0.1}
    more = {
        "image_hw": list(SIZE), "photo_files": [{"file": "a.jpg", "sha256": "0"}, None], "warnings": ["w"],
        "not_written": {"ply": "w"}, "filters": {"pixels": 1, "removed": {}}, "rejected_adapter": None,
        "recipe": {"lr": 1e-3, "hold": 0.5, "steps": 60}, "scale": {"value": 2.0, "source": "you", "spread": 0.1},
        "verdict": {"outcome": "frozen", "reason": "r", "frozen": scores, "trials": [trial, trial], "chosen": 1},
        "refinement": {
            "accepted": True, "reason": "r", "lacking": "fit", "probability": 0.9, "before": scores,
            "after": {**scores, "depth_agreement": 0.1},
        },
        "known_cameras": {
            "source": "c", "poses": 2, "intrinsics": 2, "scale": 1.0, "rotation_deg": 1.0, "position": 0.1,
            "measured": {"points": 3, "factor": 1.0}, "given": 2, "odd": ["a"], "chunks": 2, "untied": 1,
        },
        "sequence": {
            "chunks": [{"number": n, "piece": 0, "first": n, "last": n} for n in range(2)], "seams": [seam],
            "pieces": [{"folder": place, "first": 0, "last": 1, "frames": 2, "ranges": [[0, 1]]} for place in "ab"],
            "loops": [{"first": 0, "second": 1, "used": False, "similarity": 0.5, "matches": 9}],
            "frames": 2, "chunk": 1, "overlap": 0, "order": "given",
        },
    }  # fmt: skip
    files.write_json(path, {**json.loads(path.read_text()), **more})
    return path


def _demo(file: Path) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        demo.report(demo.read_scores(file), "lowtex")


def _batch(folder: Path) -> Path:
    rows = [
        SceneRow(name=name, outcome="adapted", source=["a.jpg"], views=2, seconds=1.0, warnings=0, report="r", log="l")
        for name in "ab"
    ]
    folder.mkdir(parents=True)
    files.write_json(folder / "batch.json", {"scenes": [asdict(row) for row in rows]})
    return folder / "batch.json"


def _use_batch(file: Path) -> None:
    write_overview(file.parent, "index.html", list(stored_rows(file).values()))


def _log(folder: Path) -> Path:
    folder.mkdir(parents=True)
    terms = ("translation", "points", "matching", "depth", "field_of_view", "rotation", "zero_motion")
    scores = ("auc30", "auc15", "auc05", "rotation_deg", "translation_deg", "fov_deg")
    lines = [{"kind": "step", "views": views, **dict.fromkeys(terms, 0.5)} for views in (1, 2)]
    lines.append({"kind": "evaluation", "views": 2, **{mode: dict.fromkeys(scores, 0.5) for mode in ("4", "8->4")}})
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder / "log.jsonl"


def _report(*undamaged: str) -> Callable[[Path], None]:
    """Return what writes the report without the named figures, which show nothing of the damaged file."""

    def read(file: Path) -> None:
        folder = file.parent if (file.parent / "reconstruction.json").is_file() else file.parent.parent
        with contextlib.ExitStack() as stack:
            for figure in undamaged:
                stack.enter_context(mock.patch.object(figures, figure, return_value=""))
            write_report(folder)

    return read


# The benchmark


def _bench(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        one = task()
        with mock.patch.object(splits, "photograph_room", small_room):
            store_truth(folder / "data", folder / "out", one)
        files.write_json(one.folder(folder / "out") / "scores.json", {"metrics": {"auc30": 0.5}, "failed": {}})
        evaluate_all(folder / "data", folder / "out")
        places = {
            **{file: one.folder(folder / "out") / file for file in ("task.json", "scores.json", "prediction.npz")},
            "results.jsonl": next((folder / "out").glob("*.jsonl")),
            "room.npz": next((folder / "data").rglob(f"{ROOMS[0]}.npz")),
        }  # fmt: skip
        return places[name]

    return write


def _evaluate(file: Path) -> None:
    """Score what is stored; where scores are damaged they are computed again, from what is not damaged."""
    folder = next(parent for parent in file.parents if (parent / "out").is_dir())
    with mock.patch.object(score, "_metrics", return_value=({"auc30": 0.5}, {})):
        evaluate_all(folder / "data", folder / "out")


def _stored(file: Path) -> None:
    folder = next(parent for parent in file.parents if (parent / "out").is_dir())
    stored = read_stored(task(), folder / "out")
    assert stored.prediction.depth_z is not None


def _room(file: Path) -> None:
    scene = splits.load_room("test-id", file.parent, ROOMS[0])
    scene.photos[0].read()


# Models and adapters


@cache
def _tiny() -> torch.nn.Module:
    return tiny_da3()


@cache
def _filled() -> torch.nn.Module:
    """A model for weights alone: they may stay mapped to a file, which the next case changes."""
    return tiny_da3()


def _weights(folder: Path) -> Path:
    folder.mkdir(parents=True)
    save_weights(_tiny(), folder / "model.safetensors", KEYS, {"config": "{}"})
    return folder / "model.safetensors"


def _weights_pt(folder: Path) -> Path:
    from safetensors.torch import load_file

    tensors = load_file(_weights(folder))
    torch.save({"model": tensors, "epoch": 3}, folder / "model.pt")
    return folder / "model.pt"


def _index(folder: Path) -> Path:
    from safetensors import safe_open

    weights = _weights(folder)
    with safe_open(weights, "pt") as file:
        names = dict.fromkeys(file.keys(), weights.name)
    files.write_json(folder / "model.safetensors.index.json", {"metadata": {}, "weight_map": names})
    return folder / "model.safetensors.index.json"


def _use_weights(file: Path) -> None:
    model = _filled()
    require_fit(model, file, KEYS, "tiny")
    load_weights(model, file, KEYS, "tiny")
    fingerprint(file)


def _adapter(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        adapter = trained(tiny_da3())
        save_adapter(adapter, folder, {"loss_curve": []})
        adapter.detach()
        return folder / name

    return write


def _use_adapter(file: Path) -> None:
    folder = file.parent / "latest_lora_peft" if (file.parent / "latest_lora_peft").is_dir() else file.parent
    load_adapter(_tiny(), folder).detach()


def _published(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        adapter = trained(tiny_da3())
        export_published(adapter, folder)
        adapter.detach()
        return folder / name

    return write


@cache
def _trained():
    return trained(tiny_da3())


def _parts():
    adapter = _trained()
    optimiser = torch.optim.AdamW(adapter.parameters(), lr=1e-3)
    for parameter in adapter.parameters():
        parameter.requires_grad_(True)
        parameter.grad = torch.ones_like(parameter)
    optimiser.step()
    return adapter, optimiser


def _state(folder: Path) -> Path:
    folder.mkdir(parents=True)
    adapter, optimiser = _parts()
    about = {"identity": "i", "next_step": 1, "seconds": 1.0, "curve": [{"total": 1.0}], "scaler": {}}
    earlier = {0.25: {n: p.detach().clone() for n, p in adapter.named_parameters().items()}}
    write_state(folder, adapter, optimiser, about, earlier=earlier)
    return folder / UNFINISHED_FILE


def _use_state(file: Path) -> None:
    adapter, optimiser = _parts()
    read_state(file.parent, adapter, optimiser, "i")
    for parameter in adapter.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimiser.step()


def _use_run(file: Path) -> None:
    with run_folder(file.parent, {"command": "reconstruct"}) as run:
        _ = run.finished, dict(run.notes)


# Datasets, cameras, photos


def _dataset(name: str, scene: str, place: str) -> Reader:
    def write(folder: Path) -> Path:
        shutil.copytree(DATASETS / name, folder / name)
        return folder / name / place

    def read(file: Path) -> None:
        data = file
        while data.name != name or not data.is_dir():
            data = data.parent
        try:
            loaded = registry.load_scene(data.parent, name, scene)
            truth = loaded.truth
            assert truth is not None
            photo = loaded.photos[0].read()
            registry.valid_mask(truth, 0, photo.shape[:2])
            registry.true_depth(loaded, (12, 16))
            if place.endswith(".ply"):
                from freegeo.fusion.mesh import read_mesh, read_points

                (read_points if name == "hiroom" else read_mesh)(truth.surface)
        except DAMAGED as error:
            raise FreeGeoError(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}") from error

    return Reader(f"{name} {Path(place).suffix[1:]} {Path(place).stem[:8]}", write, read)


def _photo(suffix: str) -> Reader:
    def write(folder: Path) -> Path:
        folder.mkdir(parents=True)
        pixels = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)
        image = Image.fromarray(pixels)
        exif = image.getexif()
        exif[0x0112] = 6
        image.save(folder / f"photo{suffix}", exif=exif)
        return folder / f"photo{suffix}"

    return Reader(f"photo {suffix}", write, lambda file: load_photos([file])[0].read())


def _video(folder: Path) -> Path:
    import av

    folder.mkdir(parents=True)
    with av.open(str(folder / "v.mp4"), "w") as out:
        stream = out.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        rng = np.random.default_rng(0)
        for _ in range(8):
            pixels = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        out.mux(stream.encode())
    return folder / "v.mp4"


def _deep_photo(folder: Path) -> Path:
    import cv2

    folder.mkdir(parents=True)
    pixels = np.random.default_rng(0).integers(0, 65_535, (12, 16, 3), dtype=np.uint16)
    cv2.imwrite(str(folder / "deep.png"), pixels)
    return folder / "deep.png"


def _mask(folder: Path) -> Path:
    folder.mkdir(parents=True)
    Image.fromarray(np.eye(12, 16, dtype=np.uint8) * 255).save(folder / "0.png")
    return folder / "0.png"


PHOTOS = tuple(MemoryPhoto(f"{n}.png", np.zeros((12, 16, 3), np.uint8)) for n in range(3))


def _use_cameras(path: Path) -> None:
    read_camera_file(path)
    read_cameras(path, PHOTOS)


def _camera_file(name: str, content: str) -> Reader:
    def write(folder: Path) -> Path:
        folder.mkdir(parents=True)
        (folder / name).write_text(content)
        return folder / name

    return Reader(f"cameras {name}", write, _use_cameras)


def _colmap(name: str) -> Reader:
    """A model with a camera of one kind, and two points in each image; as text where the name says so."""

    def write(folder: Path) -> Path:
        folder.mkdir(parents=True)
        params, pose = (10.0, 11.0, 8.0, 6.0, 0.1, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
        if name.endswith(".txt"):
            (folder / "cameras.txt").write_text(f"# c\n1 OPENCV 16 12 {' '.join(map(str, params))}\n")
            lines = [f"{n + 1} 1 0 0 0 {n} 0 0 1 {n}.png\n1 2 -1 3 4 -1\n" for n in range(3)]
            (folder / "images.txt").write_text("# i\n" + "".join(lines))
        else:
            camera = struct.pack("<iiQQ8d", 1, 4, 16, 12, *params)
            (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
            points = struct.pack("<Qddqddq", 2, 1, 2, -1, 3, 4, -1)
            images = [struct.pack("<i7di", n + 1, *pose, n, 0, 0, 1) + b"%d.png\0" % n + points for n in range(3)]
            (folder / "images.bin").write_bytes(struct.pack("<Q", 3) + b"".join(images))
        return folder / name

    return Reader(f"cameras {name}", write, lambda file: _use_cameras(file.parent))


MATRICES = [[[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]] for x in range(3)]
TRANSFORMS = {
    "w": 16, "h": 12, "fl_x": 10.0, "fl_y": 10.0, "cx": 8.0, "cy": 6.0, "camera_model": "OPENCV", "k1": 0.0,
    "frames": [{"file_path": f"{n}.png", "transform_matrix": matrix} for n, matrix in enumerate(MATRICES)],
}  # fmt: skip
PLAIN = {
    "metric": True,
    "frames": [
        {
            "name": f"{n}.png", "width": 16, "height": 12, "K": [[10.0, 0, 8], [0, 10, 6], [0, 0, 1]], "w2c": matrix,
            "lens": {"model": "OPENCV", "params": [0.1, 0, 0, 0]}, "image_id": n, "camera_id": 1,
        }
        for n, matrix in enumerate(MATRICES)
    ],
}  # fmt: skip
CONFIG = '[run]\nsources = ["photos"]\noutput = "out"\nformats = ["ply"]\nsteps = 50\nadapt = true\n'


def _config(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.toml").write_text(CONFIG)
    return folder / "config.toml"


READERS = (
    Reader("prediction.npz", _of_result("prediction.npz"), _export),
    Reader("kept.npz", _of_result("kept.npz"), lambda f: (load_kept(f.parent, (VIEWS, *SIZE)), load_masks(f.parent))),
    Reader("tracks.npz", _tracks, lambda f: load_tracks(f.parent, VIEWS)),
    Reader("matches.npz", _matches, _use_matches),
    Reader("reconstruction.json", _of_result("reconstruction.json"), _export),
    Reader("report prediction", _example("prediction.npz"), _report("loss_curve")),
    Reader("report summary", _summary, _report("camera_plan", "loss_curve")),
    Reader("report scores", _example("scores.json"), _report("camera_plan", "loss_curve")),
    Reader("report adapter", _example("adapter/freegeo.json"), _report("camera_plan")),
    Reader("demo scores", _example("scores.json"), _demo),
    Reader("batch", _batch, _use_batch),
    Reader("training log", _log, lambda f: read_log(f)),
    Reader("run state", _of_result(files.RUN_FILE), _use_run),
    Reader("bench task", _bench("task.json"), _evaluate),
    Reader("bench scores", _bench("scores.json"), _evaluate),
    Reader("bench prediction", _bench("prediction.npz"), _stored),
    Reader("bench results", _bench("results.jsonl"), lambda f: read_results(f.parent)),
    Reader("room.npz", _bench("room.npz"), _room),
    Reader("weights", _weights, _use_weights),
    Reader("weights.pt", _weights_pt, _use_weights),
    Reader("weights index", _index, _use_weights),
    Reader("adapter config", _adapter("adapter_config.json"), _use_adapter),
    Reader("adapter weights", _adapter("adapter_model.safetensors"), _use_adapter),
    Reader("adapter notes", _adapter("freegeo.json"), _use_adapter),
    Reader("adapter token", _adapter("camera_token.safetensors"), _use_adapter),
    Reader("published token", _published("latest_lora.pt"), _use_adapter),
    Reader("published config", _published("latest_lora_peft/adapter_config.json"), lambda f: _use_adapter(f.parent)),
    Reader("adapter state", _state, _use_state),
    _dataset("eth3d", "delivery_area", "delivery_area/dslr_calibration_jpg/cameras.txt"),
    _dataset("eth3d", "delivery_area", "delivery_area/dslr_calibration_jpg/images.txt"),
    _dataset("eth3d", "delivery_area", "delivery_area/images/dslr_images/DSC_0690.JPG"),
    _dataset("eth3d", "delivery_area", "delivery_area/masks_for_images/dslr_images/DSC_0690.png"),
    _dataset("eth3d", "delivery_area", "delivery_area/combined_mesh.ply"),
    _dataset("7scenes", "stairs", "7Scenes/stairs/seq-02/frame-000000.pose.txt"),
    _dataset("7scenes", "stairs", "7Scenes/stairs/seq-02/frame-000000.depth.png"),
    _dataset("hiroom", HIROOM, f"data/{HIROOM}/pose/0001.npy"),
    _dataset("scannetpp", "1ada7a0617", "1ada7a0617/merge_dslr_iphone/colmap/sparse_render_rgb/cameras.bin"),
    _dataset("scannetpp", "1ada7a0617", "1ada7a0617/merge_dslr_iphone/colmap/sparse_render_rgb/images.bin"),
    _dataset("scannetpp", "1ada7a0617", "1ada7a0617/merge_dslr_iphone/render_depth/frame_000000.png"),
    _camera_file("transforms.json", json.dumps(TRANSFORMS)),
    _camera_file("tum.txt", "# t x y z q\n" + "".join(f"{t}.0 0 {t} 0 0 0 0 1\n" for t in range(3))),
    _camera_file("cameras.json", json.dumps(PLAIN)),
    _camera_file("kitti.txt", "".join(f"1 0 0 {x} 0 1 0 0 0 0 1 0\n" for x in range(3))),
    _colmap("cameras.bin"), _colmap("images.bin"), _colmap("cameras.txt"), _colmap("images.txt"),
    Reader("config.toml", _config, checked_config),
    _photo(".png"), _photo(".jpg"), _photo(".tif"), _photo(".webp"), _photo(".avif"), _photo(".jp2"), _photo(".gif"),
    _photo(".bmp"), _photo(".ppm"),
    Reader("photo of 16 bits", _deep_photo, lambda file: load_photos([file])[0].read()),
    Reader("mask", _mask, lambda file: read_masks(file.parent, ["0.jpg"], [SIZE])),
    Reader("video", _video, lambda f: [frame.read() for frame in load_video(f, max_views=4)]),
)  # fmt: skip
