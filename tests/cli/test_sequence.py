"""More photos than are predicted at once: chunks, pieces, a stop in the middle, and what is said of them."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from evidence_tools import turned
from freegeo import job, load_model, reconstruct_sequence, sequence_job
from freegeo.adaptation.adapter import is_adapted
from freegeo.cameras.known import KnownCamera, KnownCameras
from freegeo.cameras.plain import write
from freegeo.data.procedural import render, sample_rooms
from freegeo.data.procedural import walk as generated_walk
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.measured import load_tracks
from freegeo.export.pixels import corner_K
from freegeo.export.reconstruction import Reconstruction, open_reconstruction
from freegeo.fusion.tracks import Tracks
from freegeo.geometry.sim3 import Sim3, align_cameras
from freegeo.metrics.pose import pair_errors
from freegeo.refined import Refined
from freegeo.sequence.chunks import Chunk
from freegeo.sequence.cuts import Jumps
from freegeo.sequence.loops import Loop
from freegeo.sequence.order import descriptors
from freegeo.sequence_job import Pace, SequenceJob
from freegeo.types import ImageBatch

FRAMES, CHUNK, OVERLAP = 14, 6, 3
CHUNKS = ["--chunk", str(CHUNK), "--overlap", str(OVERLAP), "--order", "given"]
SIDE = ["--process-res", "64"]
"""Of the true predictions, for places in photos."""
COUNT = 4
PER_VIEW = ("conf", "images", "photo_hw", "scale_xy", "offset_xy")


@dataclass
class Oracle:
    """Answers with true depth and cameras, each time in another frame and unit, in place of the model."""

    truth: Reconstruction
    asked: list[tuple[str, ...]] = field(default_factory=list)
    change: Callable[[int, Reconstruction], Reconstruction] = lambda number, result: result
    """Of an answer, by its number."""

    def __call__(self, model: object, batch: ImageBatch, **options: object) -> Reconstruction:
        number, batch = len(self.asked), batch.read()
        self.asked.append(batch.names)
        rows = [self.truth.names.index(name) for name in batch.names]
        generator = torch.Generator().manual_seed(number)
        R = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
        scale = torch.tensor(1 + 0.5 * number, dtype=torch.float64)
        own = Sim3(s=scale, R=R * torch.linalg.det(R), t=torch.randn(3, generator=generator, dtype=torch.float64))
        T, K = self.truth.cameras()
        result = replace(
            self.truth, names=batch.names, depth_z=self.truth.depth_z[rows] * np.float32(scale), K=K[rows],
            T_cam_world=own.apply_to_cameras(torch.from_numpy(T[rows]).double()).float().numpy(),
            **{name: getattr(self.truth, name)[rows] for name in PER_VIEW},
        )  # fmt: skip
        return self.change(number, result)


@pytest.fixture(scope="session")
def truth() -> Reconstruction:
    views = render(sample_rooms([20_000_003], domain="test-id", frames=FRAMES), 48, 64)
    images = (views.images[0].permute(0, 2, 3, 1) * 255).round().byte().numpy()
    return reconstruction_of(views.depth_z[0].numpy(), images, views.T_cam_world[0].numpy(), views.K[0].numpy())


def reconstruction_of(
    depth_z: np.ndarray, images: np.ndarray, T_cam_world: np.ndarray, K: np.ndarray
) -> Reconstruction:
    return Reconstruction(
        depth_z=depth_z, conf=np.ones_like(depth_z), images=images,
        names=tuple(f"{k:02d}.png" for k in range(FRAMES)), photo_hw=np.tile(depth_z.shape[1:], (FRAMES, 1)),
        scale_xy=np.ones((FRAMES, 2)), offset_xy=np.zeros((FRAMES, 2)),
        T_cam_world=T_cam_world, K=K,
    )  # fmt: skip


@pytest.fixture(scope="session")
def walk(truth, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("walk")
    for name, image in zip(truth.names, truth.images, strict=True):
        Image.fromarray(image).save(folder / name)
    return folder


@pytest.fixture
def oracle(monkeypatch, truth) -> Oracle:
    found = Oracle(truth)
    monkeypatch.setattr(job, "predict", found)
    return found


def told(folder: Path) -> dict:
    return json.loads((folder / "reconstruction.json").read_text())


def arrays(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "prediction.npz", allow_pickle=False) as content:
        return dict(content)


def test_chunks_become_one_result(freegeo, walk, tiny, tmp_path, oracle, truth):
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS, "--formats", "ply", "colmap", "npz")
    assert outcome.code == 0, outcome.err
    assert f"{FRAMES} photos in {COUNT} chunks of {CHUNK}, neighbours share {OVERLAP}" in outcome.err
    result = open_reconstruction(tmp_path / "out")
    assert result.names == truth.names
    T, K = truth.cameras()
    fit = align_cameras(torch.from_numpy(T).double(), torch.from_numpy(result.cameras()[0]).double(), ransac=False)
    np.testing.assert_allclose(fit.T_cam_world.numpy(), T, atol=2e-3)
    np.testing.assert_allclose(result.depth_z * float(fit.sim3.s), truth.depth_z, rtol=2e-3)
    np.testing.assert_allclose(result.cameras()[1], K, rtol=1e-5)
    about = told(tmp_path / "out")["sequence"]
    assert [chunk["frames"] for chunk in about["chunks"]] == [6, 6, 6, 5]
    seams = [(seam["first"], seam["second"], seam["kind"], seam["frames"]) for seam in about["seams"]]
    assert seams == [(0, 1, "neighbours", 3), (1, 2, "neighbours", 3), (2, 3, "neighbours", 3)]
    assert all(seam["used"] and seam["inliers"] > 0.99 and seam["gap"] < 1e-3 for seam in about["seams"])
    (piece,) = about["pieces"]
    ranges = [[0, FRAMES - 1]]
    assert piece == {
        "folder": ".", "first": 0, "last": FRAMES - 1, "frames": FRAMES, "ranges": ranges, "together": None,
    }  # fmt: skip
    assert len(list((tmp_path / "out/colmap").rglob("*.png"))) == FRAMES


@pytest.mark.slow
def test_one_chunk_is_the_same_as_none_to_the_bit(freegeo, walk, tiny, tmp_path):
    for name, more in (("none", []), ("one", ["--chunk", FRAMES, "--overlap", 3])):
        assert freegeo("reconstruct", walk, "-o", tmp_path / name, *tiny, *more).code == 0
    one, none = arrays(tmp_path / "one"), arrays(tmp_path / "none")
    assert one.keys() == none.keys()
    assert all(np.array_equal(one[name], none[name]) for name in one)
    for name in ("points.ply", "scene.glb"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "none" / name).read_bytes()


@pytest.mark.slow
def test_a_stopped_run_continues_at_the_first_chunk_that_is_not_finished(freegeo, walk, tiny, tmp_path, oracle):
    def stop(number: int, result: Reconstruction) -> Reconstruction:
        if number == 2:
            raise KeyboardInterrupt
        return result

    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert freegeo("reconstruct", walk, "-o", whole, *tiny, *CHUNKS).code == 0
    oracle.asked.clear()
    oracle.change = stop
    assert freegeo("reconstruct", walk, "-o", parts, *tiny, *CHUNKS).code == 130
    oracle.change = lambda number, result: result
    del oracle.asked[2:]
    assert freegeo("reconstruct", walk, "-o", parts, *tiny, *CHUNKS).code == 0
    assert len(oracle.asked) == COUNT
    one, two = arrays(whole), arrays(parts)
    assert all(np.array_equal(one[name], two[name]) for name in one)
    assert "already finished" in freegeo("reconstruct", walk, "-o", parts, *tiny, *CHUNKS).out
    assert len(oracle.asked) == COUNT


@pytest.mark.slow
def test_python_writes_what_the_command_writes(freegeo, walk, tiny, weights, tmp_path, oracle):
    assert freegeo("reconstruct", walk, "-o", tmp_path / "command", *tiny, *CHUNKS).code == 0
    oracle.asked.clear()
    model = load_model("freegeo-tiny", checkpoint=weights)
    call = {"chunk": CHUNK, "overlap": OVERLAP, "order": "given"}
    found = reconstruct_sequence(model, walk, tmp_path / "python", **call)
    assert repr(found) == f"SequenceResult({FRAMES} views)" and len(oracle.asked) == COUNT
    one, two = arrays(tmp_path / "command"), arrays(tmp_path / "python")
    assert one.keys() == two.keys() and all(np.array_equal(one[name], two[name]) for name in one)
    np.testing.assert_array_equal(found.result.depth_z, one["depth_z"])
    names = [{file.name for file in (tmp_path / place).iterdir()} for place in ("command", "python")]
    assert names[0] == names[1]
    again = reconstruct_sequence(model, walk, tmp_path / "python", **call)
    assert again.summary == found.summary and len(oracle.asked) == COUNT
    with pytest.raises(UserError, match="with other options"):
        reconstruct_sequence(model, walk, tmp_path / "python", **{**call, "overlap": 2})


@pytest.mark.slow
def test_a_dark_photo_is_named_once_and_the_plan_is_without_it(freegeo, walk, tiny, tmp_path, oracle):
    shutil.copytree(walk, tmp_path / "walk")
    Image.new("RGB", (64, 48)).save(tmp_path / "walk/05.png")
    outcome = freegeo("reconstruct", tmp_path / "walk", "-o", tmp_path / "out", *tiny, *CHUNKS)
    assert outcome.code in {0, 3}, outcome.err
    assert f"{FRAMES - 1} photos in {COUNT} chunks of {CHUNK}" in outcome.err
    assert outcome.err.count("almost black") == 1
    assert sum("05.png" in sentence for sentence in told(tmp_path / "out")["warnings"]) == 1


def test_the_time_that_is_left_is_that_of_chunks_that_were_computed():
    pace = Pace(9)
    with pace.measured():
        pass  # finished by an earlier run
    assert pace.left(1) == ""
    pace.seconds += [30.0, 10.0, 10.0]
    assert pace.left(4) == ", last one done in about 50 s"
    pace.count = 99
    assert pace.left(9) == ", last one done in about 15 min"


def test_a_loop_is_used_where_its_prediction_fits_at_both_ends():
    loop = Loop(first=1, second=12, similarity=0.9, matches=99, frames=(0, 1, 2, 11, 12, 13), reason=None)
    parts = [Chunk(frames=(0, 1, 2)), Chunk(frames=(11, 12, 13)), Chunk(frames=(0, 1, 12, 13), tie="loop")]
    fits, fails = (SimpleNamespace(first=0, second=2, reason=None), SimpleNamespace(first=1, second=2, reason="no."))
    assert sequence_job._not_closed(SimpleNamespace(joints=[fits, fails]), loop, parts, 2)
    fails.reason = None
    assert sequence_job._not_closed(SimpleNamespace(joints=[fits, fails]), loop, parts, 2) is None


def test_a_distance_across_a_cut_is_refused_before_any_prediction(freegeo, walk, tiny, tmp_path, oracle, monkeypatch):
    monkeypatch.setattr(sequence_job, "find_cuts", lambda *_: Jumps(cuts=[7], doubtful=[]))
    command = ["reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS, "--no-loops", "--scale"]
    outcome = freegeo(*command, "00.png:10,10 13.png:50,40 = 2")
    assert outcome.code == 2 and "--scale says nothing of any of the 2 parts" in outcome.sentence()
    assert oracle.asked == []


def unlike(result: Reconstruction) -> Reconstruction:
    """An answer whose depth fits nothing."""
    noise = np.random.default_rng(0).lognormal(0, 1, result.depth_z.shape)
    return replace(result, depth_z=(result.depth_z * noise).astype(np.float32))


@pytest.mark.slow
def test_a_chunk_that_fits_nowhere_is_bridged_by_the_frames_around_its_seams(freegeo, walk, tiny, tmp_path, oracle):
    oracle.change = lambda number, result: unlike(result) if number == 2 else result
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS)
    assert outcome.code == 0, outcome.err
    assert oracle.asked[COUNT:] == [tuple(f"{k:02d}.png" for k in range(*ends)) for ends in ((4, 10), (7, 13))]
    about = told(tmp_path / "out")["sequence"]
    assert [chunk["piece"] for chunk in about["chunks"]] == [0, 0, None, 0]
    assert [seam["used"] for seam in about["seams"] if seam["kind"] == "neighbours"] == [True, False, False]
    assert open_reconstruction(tmp_path / "out").names == tuple(f"{k:02d}.png" for k in range(FRAMES))


@pytest.mark.slow
def test_chunks_that_do_not_fit_are_delivered_as_pieces(freegeo, walk, tiny, tmp_path, oracle):
    oracle.change = lambda number, result: unlike(result) if number == 2 or number >= COUNT else result
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS)
    assert outcome.code == 3
    assert "of 14 photos are in the result" in outcome.err
    about = told(tmp_path / "out")["sequence"]
    assert [seam["used"] for seam in about["seams"] if seam["kind"] == "neighbours"] == [True, False, False]
    assert all(seam["reason"] for seam in about["seams"] if not seam["used"])
    folders = [tmp_path / "out" / piece["folder"] for piece in about["pieces"]]
    names = [name for folder in folders for name in open_reconstruction(folder).names]
    assert sorted(names) == sorted(set(names)) == [f"{k:02d}.png" for k in range(FRAMES)]
    assert all((folder / name).is_file() for folder in folders for name in ("points.ply", "report.html"))
    assert any("pieces" in sentence for sentence in told(tmp_path / "out")["warnings"])


def test_a_chunk_without_an_answer_is_named_and_the_rest_is_delivered(freegeo, walk, tiny, tmp_path, oracle):
    def fail(number: int, result: Reconstruction) -> Reconstruction:
        if number == 3:
            raise FreeGeoError("The model's answer is not a finite number for 5 of 5 views.")
        return result

    oracle.change = fail
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS)
    assert outcome.code == 3
    assert "Chunk 3 (frames 9-13) is left out: The model's answer is not a finite number" in outcome.err
    about = told(tmp_path / "out")["sequence"]
    assert [chunk["reason"] is None for chunk in about["chunks"]] == [True, True, True, False]
    assert open_reconstruction(tmp_path / "out").names == tuple(f"{k:02d}.png" for k in range(12))


def test_when_no_chunk_has_an_answer_the_run_fails(freegeo, walk, tiny, tmp_path, oracle):
    def fail(number: int, result: Reconstruction) -> Reconstruction:
        raise FreeGeoError("The model's answer is not a finite number for 5 of 5 views.")

    oracle.change = fail
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS)
    assert outcome.code == 1
    assert "no chunk could be predicted" in outcome.err
    assert not (tmp_path / "out/prediction.npz").exists()


@pytest.mark.slow
def test_run_adapts_once_for_all_chunks(freegeo, walk, tiny, tmp_path):
    out = tmp_path / "out"
    outcome = freegeo(
        "run", walk, "-o", out, *tiny, *CHUNKS, "--steps", "2", "--sets", "2", "--guard", "off", "--refine", "off"
    )
    assert outcome.code in {0, 3}, outcome.err
    assert (out / "adapter/adapter_model.safetensors").is_file()
    assert {chunk.name for chunk in (out / "chunks").iterdir() if chunk.is_dir()} == {f"{k:04d}" for k in range(COUNT)}
    assert all(
        (out / f"chunks/{k:04d}/{name}prediction.npz").is_file() for k in range(COUNT) for name in ("", "frozen/")
    )
    about = told(out)
    assert about["adapter"] == "adapter"
    assert about["frozen_prediction"] is None and not (out / "frozen").exists()
    windows = COUNT + (COUNT - 1)
    assert json.loads((out / "adapter/freegeo.json").read_text())["windows"] == [windows]


@pytest.mark.slow
def test_what_follows_an_adapter_that_is_not_used_is_predicted_by_the_frozen_model(
    freegeo, walk, tiny, tmp_path, monkeypatch
):
    def harmed(model, result, *more, **options):
        result.harm = "Everything is broken."

    adapted = []
    monkeypatch.setattr(sequence_job, "judge_by_photos", harmed)
    monkeypatch.setattr(SequenceJob, "_loops", lambda job: (adapted.append(is_adapted(job.model)), ([], []))[1])
    options = ("--steps", "2", "--sets", "2", "--refine", "off")
    outcome = freegeo("run", walk, "-o", tmp_path / "out", *tiny, *CHUNKS, *options)
    assert outcome.code in {0, 3}, outcome.err
    assert "Everything is broken. The result is that of the frozen model." in outcome.err
    assert adapted == [False]


def cameras_of(truth: Reconstruction) -> list[KnownCamera]:
    """The true cameras, exactly orthonormal."""
    cameras = []
    for given, K in zip(truth.cameras()[0].astype(np.float64), corner_K(truth), strict=True):
        u, _, vh = np.linalg.svd(given[:3, :3])
        T = given.copy()
        T[:3, :3] = u @ vh
        cameras.append(KnownCamera(T_cam_world=T, K=K, size_hw=(48, 64)))
    return cameras


def test_chunks_with_known_cameras_stay_where_they_are(freegeo, walk, tiny, tmp_path, oracle, truth, monkeypatch):
    """Each is told its own cameras; those of the last photo are known in part."""
    cameras = cameras_of(truth)
    cameras[-1] = replace(cameras[-1], K=None)
    file, told_them = tmp_path / "cameras.json", []
    write(KnownCameras(names=truth.names, cameras=tuple(cameras), source="x"), file)

    def predict(model: object, batch: ImageBatch, **options: object) -> Reconstruction:
        told_them.append(options["priors"] is not None)
        return oracle(model, batch)

    monkeypatch.setattr(job, "predict", predict)
    options = ("--cameras", file, "--trust-cameras", "--refine", "off")
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS, *options)
    assert outcome.code == 0, outcome.err
    expected = np.stack([camera.T_cam_world for camera in cameras])
    np.testing.assert_allclose(open_reconstruction(tmp_path / "out").cameras()[0], expected, atol=1e-12)
    assert [chunk["piece"] for chunk in told(tmp_path / "out")["sequence"]["chunks"]] == [0] * COUNT
    assert told_them == [True] * (COUNT - 1) + [False]
    assert "both are known of 13 of 14 photos" in told(tmp_path / "out")["known_cameras"]["model"]


@pytest.mark.slow
def test_known_poses_of_some_photos_put_chunks_into_their_world(freegeo, walk, tiny, tmp_path, oracle, truth):
    """One of them is wrong, and no pair of them can be checked by matches."""
    cameras = [replace(camera, K=None) for camera in cameras_of(truth)]
    given = {1: cameras[1], 5: cameras[5], 7: cameras[12], 9: cameras[9], 12: cameras[12]}
    known = tuple(given.get(frame, KnownCamera()) for frame in range(FRAMES))
    file = tmp_path / "cameras.json"
    write(KnownCameras(names=truth.names, cameras=known, source="x", metric=True), file)
    out = tmp_path / "out"
    outcome = freegeo("reconstruct", walk, "-o", out, *tiny, *CHUNKS, "--cameras", file, "--trust-cameras")
    assert outcome.code == 0, outcome.err
    result, about = open_reconstruction(out), told(out)
    np.testing.assert_allclose(result.cameras()[0], np.stack([one.T_cam_world for one in cameras]), atol=2e-3)
    np.testing.assert_allclose(result.cameras()[0][[1, 12]], [cameras[k].T_cam_world for k in (1, 12)], atol=1e-12)
    np.testing.assert_allclose(result.depth_z, truth.depth_z, rtol=2e-3)
    assert result.scale is not None and result.scale.source == f"the known cameras in {file}"
    (said,) = [said for said in about["warnings"] if "contradict the others and what the model sees" in said]
    assert "1 of 5 photos" in said and "07.png" in said
    assert {name: about["known_cameras"][name] for name in ("poses", "given", "odd", "chunks", "untied")} == {
        "poses": 4, "given": 5, "odd": ["07.png"], "chunks": COUNT, "untied": 0,
    }  # fmt: skip
    assert about["known_cameras"]["rotation_deg"] < 0.1 and about["known_cameras"]["position"] < 1e-3
    said = "5 given, 1 of them not used, 0 of 4 chunks without one; placed by them, the model"
    assert said in outcome.out and said in (out / "report.html").read_text()


def test_one_known_pose_of_a_sequence_is_refused(freegeo, walk, tiny, tmp_path, oracle, truth):
    cameras = (cameras_of(truth)[0], *[KnownCamera()] * (FRAMES - 1))
    file = tmp_path / "cameras.json"
    write(KnownCameras(names=truth.names, cameras=cameras, source="x"), file)
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS, "--cameras", file)
    assert outcome.code == 2 and not oracle.asked
    assert "known poses of two photos or more in different places, and there is one" in outcome.sentence()


@pytest.mark.slow
def test_a_distance_in_one_piece_leaves_the_others_up_to_scale(freegeo, walk, tiny, tmp_path, oracle):
    oracle.change = lambda number, result: unlike(result) if number == 2 or number >= COUNT else result
    distance = "00.png:10,10 01.png:50,40 = 2"
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS, *SIDE, "--scale", distance)
    assert outcome.code == 3, outcome.err
    about = told(tmp_path / "out")
    scales = [told(tmp_path / "out" / piece["folder"])["scale"] for piece in about["sequence"]["pieces"]]
    assert scales[0]["source"] == "a measured distance" and scales[1:] == [None] * (len(scales) - 1)
    assert len(scales) > 1 and any("--scale says nothing of the piece" in said for said in about["warnings"])


@pytest.mark.slow
def test_photos_in_an_order_of_their_own_are_described_once(freegeo, walk, tiny, tmp_path, oracle, truth, monkeypatch):
    described = []
    monkeypatch.setattr(
        sequence_job, "descriptors", lambda *given: described.append(found := descriptors(*given)) or found
    )
    options = ("--order", "similar")
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS[:4], *options)
    assert outcome.code in {0, 3}, outcome.err
    about = told(tmp_path / "out")
    assert about["sequence"]["order"] == "similar" and len(described) == 1
    assert "what each photo shows" in about["seconds"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--chunk", "many"], "--chunk is auto or a number of photos"),
        (["--chunk", "1"], "--chunk is auto or a number of photos"),
        (["--chunk", "6", "--overlap", "6"], "share from 1 to 5 of them (--overlap), got 6"),
        (["--chunk", "6", "--overlap", "0"], "share from 1 to 5 of them (--overlap), got 0"),
    ],
)
def test_chunks_that_cannot_be_are_refused(freegeo, walk, tiny, tmp_path, options, words):
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *options)
    assert outcome.code == 2
    assert words in outcome.sentence()
    assert not (tmp_path / "out").exists()


def test_chunks_that_are_too_small_to_adapt_to_are_refused_at_once(freegeo, walk, tiny, tmp_path, oracle):
    outcome = freegeo("run", walk, "-o", tmp_path / "out", *tiny, "--chunk", 2)
    assert outcome.code == 2
    assert "chunks of 2 photos: adaptation needs at least 3 in each" in outcome.sentence()
    assert not oracle.asked


@pytest.mark.slow
def test_auto_keeps_the_chunks_of_an_earlier_run(freegeo, walk, tiny, tmp_path, oracle):
    """What fits into memory may have changed since."""
    out, auto = tmp_path / "out", ["--chunk", "auto", "--overlap", OVERLAP, "--order", "given"]
    assert freegeo("reconstruct", walk, "-o", out, *tiny, *CHUNKS).code == 0
    assert "already finished" in freegeo("reconstruct", walk, "-o", out, *tiny, *auto).out
    assert freegeo("reconstruct", walk, "-o", out, *tiny, *auto, "--overwrite").code == 0
    assert "sequence" not in told(out)


@pytest.mark.slow
def test_joining_in_another_way_predicts_nothing_again(freegeo, walk, tiny, tmp_path, oracle):
    out = tmp_path / "out"
    assert freegeo("reconstruct", walk, "-o", out, *tiny, *CHUNKS).code == 0
    asked = len(oracle.asked)
    assert freegeo("reconstruct", walk, "-o", out, *tiny, *CHUNKS, "--no-loops").code == 0
    assert len(oracle.asked) == asked
    assert told(out)["settings"]["joining"] == {"loops": False}


def test_photos_that_show_nothing_are_refused_when_there_are_no_others(freegeo, tiny, tmp_path):
    (tmp_path / "dark").mkdir()
    for k in range(FRAMES):
        Image.new("RGB", (64, 48)).save(tmp_path / f"dark/{k:02d}.png")
    outcome = freegeo("reconstruct", tmp_path / "dark", "-o", tmp_path / "out", *tiny, *CHUNKS)
    assert outcome.code == 2
    assert "all 14 photos are almost black" in outcome.sentence()
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_camera_that_stands_still_is_said(freegeo, walk, tiny, tmp_path, oracle, truth):
    still = tmp_path / "still"
    still.mkdir()
    for k in range(FRAMES):
        Image.fromarray(truth.images[k if k < 5 else 5]).save(still / f"{k:02d}.png")
    outcome = freegeo("reconstruct", still, "-o", tmp_path / "out", *tiny, *CHUNKS)
    assert "The photos 05.png to 13.png are the same picture" in outcome.err


@pytest.mark.slow
def test_a_photo_alone_beyond_a_cut_is_a_piece(freegeo, walk, tiny, tmp_path, oracle, monkeypatch):
    monkeypatch.setattr(sequence_job, "find_cuts", lambda *_: Jumps(cuts=[FRAMES - 1], doubtful=[]))
    outcome = freegeo("reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS)
    assert outcome.code == 3, outcome.err
    assert open_reconstruction(tmp_path / "out/pieces/2").names == ("13.png",)


@pytest.mark.slow
def test_descriptors_belong_to_the_order_also_after_a_stop(freegeo, walk, tiny, tmp_path, oracle, monkeypatch):
    seen = []

    def cuts(descriptors: np.ndarray, photos: object) -> Jumps:
        seen.append(descriptors)
        if len(seen) == 1:
            raise KeyboardInterrupt
        return Jumps(cuts=[], doubtful=[])

    order = [*range(0, FRAMES, 2), *range(1, FRAMES, 2)]
    monkeypatch.setattr(sequence_job, "similarity_order", lambda descriptors: order)
    monkeypatch.setattr(sequence_job, "find_cuts", cuts)
    command = ["reconstruct", walk, "-o", tmp_path / "out", *tiny, *CHUNKS[:4], "--order", "similar"]
    assert freegeo(*command).code == 130
    assert freegeo(*command).code == 0
    np.testing.assert_array_equal(seen[0], seen[1])
    with np.load(tmp_path / "out/chunks/descriptors.npz") as content:
        np.testing.assert_array_equal(content["descriptors"][order], seen[1])


@pytest.mark.slow
def test_all_photos_are_refined_together(freegeo, tiny, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    scene = generated_walk(20_000_100, "tex", 240).scene(range(FRAMES))
    depth_z, images = scene.depth_z.numpy(), np.stack([photo.read() for photo in scene.photos])
    truth = reconstruction_of(depth_z, images, scene.T_cam_world.numpy(), scene.K.numpy())
    for name, image in zip(truth.names, truth.images, strict=True):
        Image.fromarray(image).save(tmp_path / name)

    def bent(number: int, answer: Reconstruction) -> Reconstruction:
        T = turned(torch.from_numpy(answer.cameras()[0]).double(), 90.0 if number % COUNT == 1 else 3.0, seed=number)
        return replace(answer, T_cam_world=T.float().numpy())

    monkeypatch.setattr(job, "predict", Oracle(truth, change=bent))
    out = tmp_path / "out"
    options = ("--process-res", "256", "--refine", "ba", "--no-loops", "--formats", "colmap")
    outcome = freegeo("reconstruct", tmp_path, "-o", out, *tiny, *CHUNKS, *options)
    assert outcome.code == 0, outcome.err
    (piece,) = told(out)["sequence"]["pieces"]
    assert piece["together"]["accepted"] and piece["together"]["after_px"] < 0.5
    assert "All photos together: Matches that had no part in it fit better" in told(out)["refinement"]["reason"]
    result = open_reconstruction(out)
    errors = pair_errors(*(torch.from_numpy(one.cameras()[0]).double() for one in (result, truth)))
    assert errors.worst_deg.median() < 0.5
    # The chunk that no matches prove is left out; its matches join those beside it, which share no frame.
    lost = told(out)["sequence"]["chunks"][1]
    assert lost["piece"] is None and lost["reason"].startswith("no matches prove its cameras")
    seams = {(seam["first"], seam["second"]): seam["frames"] for seam in told(out)["sequence"]["seams"]}
    assert seams == {(0, 2): 0, (2, 3): OVERLAP}
    tracks = load_tracks(out, FRAMES)
    assert tracks is not None and set(tracks.view.tolist()) == set(range(FRAMES))
    first, last = (np.full(len(tracks), start) for start in (FRAMES, -1))
    np.minimum.at(first, tracks.point, tracks.view)
    np.maximum.at(last, tracks.point, tracks.view)
    assert (last - first).max() >= CHUNK, "points are followed from chunk to chunk"
    assert "measured" in (out / "colmap/README.txt").read_text()
    # Chunks may be removed; what is made again of them is the same, that of the refused one included.
    shutil.rmtree(out / "chunks")
    assert freegeo("reconstruct", tmp_path, "-o", out, *tiny, *CHUNKS, *options, "tum").code == 0
    assert told(out)["sequence"]["chunks"][1]["spare"] and told(out)["sequence"]["pieces"][0]["together"]["accepted"]


@pytest.mark.slow
def test_chunks_that_were_removed_are_refined_again(freegeo, walk, tiny, tmp_path, oracle, monkeypatch):
    refined = []

    def refine(prediction: Reconstruction, *_: object, **__: object) -> Refined:
        refined.append(prediction.names)
        K = prediction.cameras()[1] * np.array([[1.25, 1, 1], [1, 1.25, 1], [1, 1, 1]], np.float32)
        point = Tracks(
            xyz=np.zeros((1, 3)), colours=np.zeros((1, 3), np.uint8), point=np.zeros(2, int), view=np.arange(2),
            pixel=np.zeros((2, 2)),
        )  # fmt: skip
        scores = {
            "epipolar_px": 1.0, "reprojection_px": 1.0, "scale_drift": 0.0, "depth_agreement": 1.0, "matches": 9,
        }  # fmt: skip
        about = {
            "accepted": True, "reason": "It fits.", "lacking": None, "probability": 1.0, "pairs": 1, "told": False,
            "misfit": None, "frozen": None, "before": scores, "after": scores,
        }  # fmt: skip
        return Refined(result=replace(prediction, K=K), tracks=point, about=about)

    monkeypatch.setattr(job, "refine_by_photos", refine)
    out = tmp_path / "out"
    command = ["reconstruct", walk, "-o", out, *tiny, *CHUNKS, "--refine", "ba"]
    assert freegeo(*command).code == 0
    before = arrays(out)
    shutil.rmtree(out / "chunks")
    assert freegeo(*command, "--formats", "tum").code == 0
    assert len(refined) == 2 * COUNT
    np.testing.assert_array_equal(before["K"], arrays(out)["K"])
