"""Known cameras: they reach models and adaptation as they should, and results have them as they were given."""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import freegeo
from evidence_tools import exact_matches, without_matches
from exact_rooms import room
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.samples import Samples, SceneImages
from freegeo.adaptation.state import UNFINISHED_FILE
from freegeo.adaptation.views import schedule
from freegeo.cameras.known import KnownCamera, KnownCameras, Lens
from freegeo.errors import UserError
from freegeo.evidence.candidate import Candidate
from freegeo.export.pixels import corner_K
from freegeo.export.reconstruction import Reconstruction
from freegeo.files import read_json
from freegeo.geometry.rotation import quat_xyzw_to_matrix
from freegeo.geometry.se3 import camera_centres, from_Rt
from freegeo.geometry.sim3 import DegenerateAlignmentError, Sim3, fit_cameras
from freegeo.models.precision import Compute
from freegeo.models.priors import usable_by_both
from freegeo.posed import (
    check_known,
    digest,
    doubt_focal_length,
    is_measurable,
    known_cameras,
    priors_of,
    told,
    told_in_chunks,
    told_of,
    undistorted_masks,
    with_known_cameras,
    with_measured_depth,
    with_poses,
)
from tiny_models import (
    attach,
    noise,
    quick,
    same,
    tensors,
    tiny_da3,
    tiny_mapanything,
    tiny_nested,
    tiny_single_view,
    tiny_vggt,
)  # fmt: skip

VIEWS = 5
FACTOR = 0.37


def known_of(scene: Reconstruction, poses=None, K=None, **changes) -> KnownCameras:
    """The exact cameras of a room, of all views or of those named, rotations exact to double precision."""
    views = range(len(scene))
    inner = corner_K(scene)
    cameras = tuple(
        KnownCamera(
            T_cam_world=exact(scene.T_cam_world[i]) if poses is None or i in poses else None,
            K=inner[i] if K is None or i in K else None,
        )
        for i in views
    )
    return KnownCameras(**{"names": scene.names, "cameras": cameras, "source": "cameras.json", **changes})


def exact(T: np.ndarray) -> np.ndarray:
    u, _, vh = np.linalg.svd(T[:3, :3].astype(np.float64))
    return np.block([[u @ vh, T[:3, 3:].astype(np.float64)], [np.array([[0, 0, 0, 1.0]])]])


def predicted(scene: Reconstruction, factor: float = FACTOR, noise: float = 0.0, seed: int = 0) -> Reconstruction:
    """A room as a model would predict it: in another world frame and unit, with noise relative to the path."""
    generator = torch.Generator().manual_seed(seed)
    quaternion = torch.nn.functional.normalize(torch.randn(4, generator=generator, dtype=torch.float64), dim=0)
    sim3 = Sim3(
        s=torch.tensor(1 / factor, dtype=torch.float64), R=quat_xyzw_to_matrix(quaternion),
        t=torch.randn(3, generator=generator, dtype=torch.float64),
    )  # fmt: skip
    T = sim3.apply_to_cameras(torch.from_numpy(scene.T_cam_world).double())
    centres = camera_centres(T)
    step = noise * float(torch.cdist(centres, centres).max())
    centres = centres + step * torch.randn(centres.shape, generator=generator, dtype=torch.float64)
    T = from_Rt(T[:, :3, :3], -(T[:, :3, :3] @ centres[..., None])[..., 0])
    return replace(scene, T_cam_world=T.float().numpy(), depth_z=scene.depth_z / np.float32(factor))


def along(views: int) -> torch.Tensor:
    """Cameras on a straight path, all looking the same way."""
    T = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    T[:, 0, 3] = -torch.linspace(0, 3, views)
    return T


# The fit ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("views", [2, 9])
def test_two_cameras_or_a_straight_path_give_the_scale_within_a_percent(views):
    generator = torch.Generator().manual_seed(5)
    truth = along(views)
    R = quat_xyzw_to_matrix(torch.tensor([0.5, 0.5, -0.5, 0.5], dtype=torch.float64))
    sim3 = Sim3(s=torch.tensor(1 / FACTOR, dtype=torch.float64), R=R, t=torch.ones(3, dtype=torch.float64))
    moved = sim3.apply_to_cameras(truth)
    moved[:, :3, 3] += 0.003 / FACTOR * torch.randn(views, 3, generator=generator, dtype=torch.float64)
    fit = fit_cameras(moved, truth)
    assert float(fit.sim3.s) == pytest.approx(FACTOR, rel=0.01)
    assert fit.position < 0.01 and fit.rotation_deg < 0.01
    assert (fit.spread is None) == (views == 2)


def test_cameras_in_one_place_give_no_scale():
    T = along(3)
    turned = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    assert not fit_cameras(T, turned).has_scale
    with pytest.raises(DegenerateAlignmentError, match="cameras in one place"):
        fit_cameras(turned, T)


# The result -----------------------------------------------------------------------------------------------------------


def test_known_cameras_come_back_exactly_and_depth_gets_their_scale():
    scene = room(VIEWS)
    known = known_of(scene, metric=True)
    posed = with_known_cameras(predicted(scene), known)
    for view, camera in enumerate(known.cameras):
        assert np.array_equal(posed.result.T_cam_world[view], camera.T_cam_world)
        np.testing.assert_allclose(corner_K(posed.result)[view], camera.K, atol=1e-9)
    np.testing.assert_allclose(posed.result.depth_z, scene.depth_z, rtol=1e-4)
    assert posed.result.scale.value == pytest.approx(FACTOR, rel=1e-4)
    assert posed.about["position"] < 1e-3 and posed.about["rotation_deg"] < 0.01
    assert with_known_cameras(predicted(scene), known_of(scene)).result.scale is None


@pytest.mark.parametrize("format", ["npz", "colmap", "nerfstudio"])
def test_exported_cameras_are_the_given_ones(format, tmp_path):
    scene = room(VIEWS, crop=3)
    far = [
        exact(T) @ from_Rt(torch.eye(3), torch.tensor([-300.0, 20.0, 5.0])).double().numpy() for T in scene.T_cam_world
    ]
    known = known_of(scene)
    known = replace(known, cameras=tuple(replace(c, T_cam_world=T) for c, T in zip(known.cameras, far, strict=True)))
    result = with_known_cameras(predicted(scene), known).result
    result.export(tmp_path, [format])
    poses, K = READERS[format](tmp_path)
    for view, camera in enumerate(known.cameras):
        np.testing.assert_allclose(poses[view], camera.T_cam_world, atol=1e-6)
        np.testing.assert_allclose(K[view], camera.K, atol=1e-6)


def read_npz(folder):
    opened = Reconstruction.load(folder)
    return opened.T_cam_world, corner_K(opened)


def read_colmap(folder):
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(folder / "colmap" / "sparse" / "0")
    images = [model.images[i] for i in sorted(model.images)]
    poses = [np.vstack([i.cam_from_world().matrix(), [0, 0, 0, 1]]) for i in images]
    return poses, [model.cameras[i.camera_id].calibration_matrix() for i in images]


def read_nerfstudio(folder):
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    poses = [np.diag([1, -1, -1, 1]) @ np.linalg.inv(np.array(frame["transform_matrix"])) for frame in frames]
    return poses, [np.array([[f["fl_x"], 0, f["cx"]], [0, f["fl_y"], f["cy"]], [0, 0, 1]]) for f in frames]


READERS = {"npz": read_npz, "colmap": read_colmap, "nerfstudio": read_nerfstudio}


def test_views_without_a_known_pose_move_along():
    scene = room(VIEWS)
    posed = with_known_cameras(predicted(scene), known_of(scene, poses=(1, 3), K=(0,)))
    np.testing.assert_allclose(posed.result.T_cam_world, scene.T_cam_world, atol=1e-3)
    for view in (1, 3):
        assert np.array_equal(posed.result.T_cam_world[view], exact(scene.T_cam_world[view]))
    assert posed.about["poses"] == 2 and posed.about["intrinsics"] == 1
    np.testing.assert_allclose(posed.result.depth_z, scene.depth_z, rtol=1e-3)


def test_one_known_pose_gives_the_frame_and_no_scale(caplog):
    scene = room(VIEWS)
    posed = with_known_cameras(predicted(scene), known_of(scene, poses=(2,), K=()))
    assert np.array_equal(posed.result.T_cam_world[2], exact(scene.T_cam_world[2]))
    np.testing.assert_allclose(posed.result.depth_z * np.float32(FACTOR), scene.depth_z, rtol=1e-5)
    assert "one known pose gives no scale" in caplog.text


def test_intrinsics_alone_are_returned_and_depth_stays(caplog):
    scene, before = room(VIEWS), predicted(room(VIEWS))
    wide = replace(before, K=before.K * np.array([[0.8, 1, 1], [1, 0.8, 1], [1, 1, 1]], np.float32))
    posed = with_known_cameras(wide, known_of(scene, poses=()))
    np.testing.assert_allclose(corner_K(posed.result), corner_K(scene), atol=1e-4)
    assert np.array_equal(posed.result.depth_z, before.depth_z)
    assert np.allclose(posed.result.T_cam_world, before.T_cam_world)
    assert "1.25 times those that the model sees" in caplog.text


def test_a_prediction_that_sees_other_cameras_is_doubted(caplog):
    scene = room(VIEWS)
    with_known_cameras(predicted(scene), known_of(scene))
    assert not caplog.records
    with_known_cameras(predicted(scene, noise=0.5), known_of(scene))
    assert "its depth does not fit them" in caplog.text


def test_metres_of_the_cameras_and_of_a_metric_model_are_compared(caplog):
    from freegeo.export.reconstruction import METRIC_MODEL, Scale

    scene = room(VIEWS)
    before = replace(predicted(scene), scale=Scale(value=2.0, source=METRIC_MODEL))
    assert with_known_cameras(before, known_of(scene, metric=True)).result.scale.value == pytest.approx(
        FACTOR, rel=1e-3
    )
    assert "its metres are 0.37 times those of the model" in caplog.text


def test_a_model_without_cameras_cannot_use_known_ones():
    scene = room(VIEWS)
    with pytest.raises(UserError, match="predicts no cameras"):
        with_known_cameras(replace(scene, T_cam_world=None, K=None), known_of(scene))


def test_a_model_without_cameras_is_refused_before_it_predicts(photos):
    for options in ({"cameras": known_for(photos)}, {"scale": "gps"}):
        with pytest.raises(UserError, match="predicts no cameras, so known ones and a scale"):
            freegeo.reconstruct(tiny_single_view(), photos, **options)


def test_map_coordinates_are_refused():
    scene = room(VIEWS)
    photos = freegeo.load_photos(list(scene.images))
    shift = from_Rt(torch.eye(3), torch.tensor([-5e5, -5e6, 0.0])).double().numpy()
    known = known_of(scene, names=tuple(photo.name for photo in photos))
    far = replace(known, cameras=tuple(replace(c, T_cam_world=c.T_cam_world @ shift) for c in known.cameras))
    known_cameras(photos, known)
    with pytest.raises(UserError, match=r"Subtract \(\d{6}, 5\d{6}, "):
        known_cameras(photos, far)
    with pytest.raises(UserError, match="not of these 4"):
        known_cameras(photos[:4], known)


# The model ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def photos():
    return freegeo.load_photos(list((noise(VIEWS).permute(0, 2, 3, 1) * 255).round().byte().numpy()))


def known_for(photos, seed=0, **changes) -> KnownCameras:
    scene = room(len(photos), seed=3 + seed)
    K = np.array([[30.0, 0, 16], [0, 28, 16], [0, 0, 1]])
    cameras = tuple(KnownCamera(T_cam_world=exact(T), K=K) for T in scene.T_cam_world)
    return KnownCameras(**{"names": tuple(p.name for p in photos), "cameras": cameras, "source": "a file", **changes})


def test_intrinsics_in_photo_pixels_become_the_models_by_the_rule_of_exports(photos):
    model = tiny_da3()
    batch = model.preprocess(photos)
    batch = replace(batch, scale_xy=batch.scale_xy * 1.7, offset_xy=batch.offset_xy - 3)
    K = priors_of(known_for(photos), batch).K[0].numpy()
    back = Reconstruction(
        depth_z=np.ones((VIEWS, 32, 32), np.float32), conf=np.ones((VIEWS, 32, 32), np.float32), K=K,
        T_cam_world=np.tile(np.eye(4), (VIEWS, 1, 1)), images=np.zeros((VIEWS, 32, 32, 3), np.uint8), names=batch.names,
        photo_hw=batch.photo_hw.numpy(), scale_xy=batch.scale_xy.numpy(), offset_xy=batch.offset_xy.numpy(),
    )  # fmt: skip
    np.testing.assert_allclose(corner_K(back), [c.K for c in known_for(photos).cameras], atol=1e-12)


def test_models_say_what_they_are_told(photos):
    batch = tiny_da3().preprocess(photos)
    known = known_for(photos)
    part = replace(known, cameras=(KnownCamera(K=known.cameras[0].K), *known.cameras[1:]))
    cases = [(tiny_da3(), known, True, "is told"), (tiny_da3(), part, False, "of all photos, or none"),
             (tiny_vggt(), known, False, "takes no cameras")]  # fmt: skip
    for model, cameras, given, words in cases:
        priors, sentence = told(cameras, batch, model.spec)
        assert (priors is not None) == given and words in sentence


def test_a_model_that_takes_parts_says_which_ones(photos):
    model = tiny_mapanything()
    batch, known = model.preprocess(photos), known_for(photos)

    def without_poses(*views):
        cameras = [KnownCamera(K=c.K) if i in views else c for i, c in enumerate(known.cameras)]
        return replace(known, cameras=tuple(cameras))

    all_but_first = range(1, VIEWS)
    alone = without_poses(*all_but_first)
    # A chunk is told its part of what the sequence can be told, whatever is known of its own first photo.
    whole, _ = told(without_poses(0), batch, model.spec)
    chunk, said = told_of(known.select([1, 2]), whole.select([1, 2]), model.spec)
    assert chunk.T_cam_world is None and said.endswith("a file: intrinsics of 2 photos.")
    cases = [
        (known, True, "is told the cameras of a file."),
        (without_poses(2), True, f"a file: poses of {VIEWS - 1} and intrinsics of {VIEWS} photos."),
        (without_poses(0), False, f"a file: intrinsics of {VIEWS} photos. tiny-mapanything takes poses relative to the "
         "first photo, whose own is not known: poses are left out."),
        (alone, False, "only one is known: poses are left out."),
    ]  # fmt: skip
    for cameras, posed, words in cases:
        priors, sentence = told(cameras, batch, model.spec)
        assert (priors.T_cam_world is not None) == posed and words in sentence
    one = KnownCamera(T_cam_world=known.cameras[0].T_cam_world)
    nothing = replace(known, cameras=(one, *[KnownCamera()] * (VIEWS - 1)))
    priors, sentence = told(nothing, batch, model.spec)
    assert priors is None and "sees the photos alone. The cameras of a file have no part" in sentence


def test_reconstruct_tells_the_model_and_returns_the_given_cameras(photos, caplog):
    caplog.set_level(logging.INFO, "freegeo")
    model, known = tiny_da3(), known_for(photos)
    alone, given = (freegeo.reconstruct(model, photos, cameras=c, trust_cameras=True) for c in (None, known))
    assert np.array_equal(given.T_cam_world, np.stack([c.T_cam_world for c in known.cameras]))
    ratio = given.depth_z / alone.depth_z
    assert ratio.std() / ratio.mean() > 1e-4  # told, not only scaled
    with pytest.raises(UserError, match="--reference out"):
        freegeo.reconstruct(model, photos, cameras=known, trust_cameras=True, reference="middle")
    # A metric model is told through its any-view part; the known cameras, of no known unit, decide the lengths.
    nested = freegeo.reconstruct(tiny_nested(), photos, cameras=known, trust_cameras=True)
    assert np.array_equal(nested.T_cam_world, given.T_cam_world) and nested.scale is None
    # VGGT is not told, which the log says, and its result has the cameras all the same.
    model = tiny_vggt()
    alone, given = (freegeo.reconstruct(model, photos, cameras=c, trust_cameras=True) for c in (None, known))
    ratio = given.depth_z / alone.depth_z
    assert ratio.std() / ratio.mean() < 1e-5
    assert np.array_equal(given.T_cam_world, np.stack([c.T_cam_world for c in known.cameras]))
    assert "tiny-vggt takes no cameras" in caplog.text


# Adaptation -----------------------------------------------------------------------------------------------------------


def scene_with_priors(model, photos, known) -> SceneImages:
    batch = model.preprocess(photos)
    return replace(SceneImages.from_batch("s", batch), priors=priors_of(known, batch))


@pytest.mark.parametrize("hold", [0.0, 1.0])
@torch.no_grad()
def test_teacher_and_student_are_told_the_cameras_of_their_views(photos, hold):
    model, known = tiny_da3(), known_for(photos)
    scene, recipe = scene_with_priors(model, photos, known), quick(model, views=4, hold=hold)
    steps = schedule([VIEWS], recipe, seed=1)
    samples = Samples(attach(model), [scene], recipe, steps, compute=Compute(), place="device", folder=None, seed=1)
    layers = model.spec.loss_layers
    for visit in [visit for visits in steps for visit in visits][:2]:
        sample, frames, kept = samples.take(visit), visit.view_set.frames, list(visit.view_set.kept)
        tokens = model.embed(scene.load(frames)[None])
        teacher = model.aggregate(tokens, layers=layers, priors=scene.priors.select(frames)).levels
        without = model.aggregate(tokens, layers=layers).levels
        for layer in layers:
            assert torch.allclose(sample.student().teacher.levels[layer][0], teacher[layer][0][:, kept], atol=1e-5)
        assert not torch.allclose(teacher[layers[-1]][0], without[layers[-1]][0], atol=1e-3)
        # The student's own first view is the reference of its cameras.
        chosen = [frames[k] for k in kept]
        assert torch.equal(sample.student().priors.T_cam_world, scene.priors.T_cam_world[:, chosen])
    samples.close()


def test_teacher_and_student_are_told_the_same(photos):
    model = tiny_mapanything()
    priors = priors_of(known_for(photos), model.preprocess(photos))
    for posed, kept, used in (((0, 1), (0, 2, 4), False), ((0, 2), (0, 2, 4), True), ((1, 2), (0, 2), False)):
        some = replace(priors, has_pose=torch.tensor([view in posed for view in range(VIEWS)]))
        found = usable_by_both(some, kept, model.spec)
        assert (found.T_cam_world is not None) == used and torch.equal(found.K, priors.K)
        assert used or usable_by_both(replace(some, K=None), kept, model.spec) is None
    # A student that would see one pose of the set is adapted all the same.
    scene = replace(SceneImages.from_batch("s", model.preprocess(photos)), priors=some)
    assert adapt(model, [scene], quick(model, views=4, steps=1), seed=1).trouble is None


@pytest.mark.slow
def test_an_adapter_trained_with_cameras_is_another_one_and_says_so(photos, tmp_path):
    options = {"steps": 2, "sets": 2, "guard": "off", "trust_cameras": True}
    results = []
    for cameras in (None, known_for(photos), known_for(photos, seed=1)):
        model = tiny_da3()
        results.append(freegeo.adapt(model, photos, cameras=cameras, **options))
        results[-1].save(tmp_path / str(len(results)))
    assert [read_json(tmp_path / str(n) / "freegeo.json")["with_cameras"] for n in (1, 2, 3)] == [False, True, True]
    assert not same(tensors(results[0]), tensors(results[1])) and not same(tensors(results[1]), tensors(results[2]))


@pytest.mark.slow
def test_an_adapter_trained_with_cameras_and_used_without_is_doubted(photos, tmp_path, caplog):
    options = {"cameras": known_for(photos), "trust_cameras": True}
    made = freegeo.adapt(tiny_da3(), photos, steps=2, sets=2, guard="off", **options)
    made.save(tmp_path)
    caplog.clear()
    freegeo.reconstruct(tiny_da3(), photos, adapter=tmp_path, **options)
    assert "the adapter was trained" not in caplog.text
    freegeo.reconstruct(tiny_da3(), photos, adapter=tmp_path)
    assert "trained with known cameras, and is used without them" in caplog.text


def test_an_unfinished_run_is_not_continued_with_other_cameras(photos, tmp_path):
    def stopped(progress):
        if progress.step == 1:
            raise KeyboardInterrupt

    known = known_for(photos)
    options = {"steps": 4, "sets": 2, "guard": "off", "trust_cameras": True, "resume_in": tmp_path}
    with pytest.raises(KeyboardInterrupt):
        freegeo.adapt(tiny_da3(), photos, cameras=known, on_step=stopped, **options)
    assert (tmp_path / UNFINISHED_FILE).is_file()
    with pytest.raises(UserError, match="belongs to another run"):
        freegeo.adapt(tiny_da3(), photos, cameras=known_for(photos, seed=1), **options)
    assert len(freegeo.adapt(tiny_da3(), photos, cameras=known, **options).curve) == 4


def test_recipes_that_change_images_take_no_cameras(photos):
    from freegeo.adaptation.adapt import adapt

    model = tiny_da3()
    scene = scene_with_priors(model, photos, known_for(photos))
    with pytest.raises(UserError, match="mirrors or squashes"):
        adapt(model, [scene], quick(model, augmentation="released"), seed=0)


# Fingerprints, masks --------------------------------------------------------------------------------------------------


def test_everything_known_is_in_the_fingerprint(photos):
    known = known_for(photos)
    first = known.cameras[0]
    others = [
        replace(known, metric=True), known_for(photos, seed=1),
        *(replace(known, cameras=(replace(first, **change), *known.cameras[1:])) for change in (
            {"K": None}, {"T_cam_world": None}, {"lens": Lens("SIMPLE_RADIAL", (0.1,))})),
    ]  # fmt: skip
    assert len({digest(known), *map(digest, others)}) == len(others) + 1
    assert digest(replace(known, source="elsewhere")) == digest(known)


def test_photos_with_distortion_are_undistorted_once_and_written_so(photos, tmp_path):
    pytest.importorskip("cv2")
    known = known_for(photos)
    bent = replace(known, cameras=tuple(replace(c, lens=Lens("SIMPLE_RADIAL", (-0.2,))) for c in known.cameras))
    with pytest.raises(UserError, match="Undistort them, and use the new photos"):
        freegeo.reconstruct(tiny_da3(), photos, cameras=bent, trust_cameras=True)
    straight, pinholes = known_cameras(photos, bent)
    result = freegeo.reconstruct(tiny_da3(), straight, cameras=pinholes, trust_cameras=True)
    result.export(tmp_path, ["nerfstudio"], photos=straight)
    _, K = read_nerfstudio(tmp_path)
    for view, photo in enumerate(straight):
        np.testing.assert_allclose(K[view], photo.K, atol=1e-9)
        written = np.asarray(Image.open(tmp_path / "images" / f"{photo.name}.png"))
        assert np.array_equal(written, photo.read()) and not np.array_equal(written, photos[view].read())


def test_masks_follow_their_undistorted_photos(photos):
    pytest.importorskip("cv2")
    known = known_for(photos)
    bent = tuple(replace(c, lens=Lens("SIMPLE_RADIAL", (-0.4,))) for c in known.cameras)
    straight, _ = known_cameras(photos, replace(known, cameras=bent))
    pattern = [np.kron(np.indices((8, 8)).sum(0) % 2, np.ones((4, 4), np.uint8)).astype(np.uint8) for _ in photos]
    painted = [
        replace(p, photo=replace(p.photo, pixels=np.repeat(255 * m[..., None], 3, -1)))
        for p, m in zip(straight, pattern, strict=True)
    ]
    for mask, photo in zip(undistorted_masks(pattern, straight), painted, strict=True):
        assert ((photo.read()[..., 0] > 127) == mask).mean() > 0.9
    assert (undistorted_masks(pattern, straight)[0] != pattern[0]).mean() > 0.05
    assert undistorted_masks(None, straight) is None


# -- depth by measured points


def test_measured_points_bring_each_view_s_depth_to_the_known_cameras():
    scene = room(views=6, hw=(72, 96), seed=5)
    known, matches = known_of(scene, metric=True), exact_matches(Candidate.of(scene), noise_px=0.2)
    wrong = np.array([0.8, 0.9, 1.0, 1.1, 1.2, 1.4], np.float32)[:, None, None]
    before = predicted(scene)
    posed = with_known_cameras(replace(before, depth_z=before.depth_z * wrong), known)
    assert is_measurable(posed, known)
    found = with_measured_depth(posed, known, matches)
    off = np.median(found.result.depth_z / scene.depth_z, axis=(1, 2))
    assert np.abs(off - 1).max() < 0.01 < np.abs(np.median(posed.result.depth_z / scene.depth_z, axis=(1, 2)) - 1).max()
    assert np.array_equal(found.result.T_cam_world, posed.result.T_cam_world)
    measured = found.about["measured"]
    assert measured["views"] == 6 and measured["points"] > 30
    assert found.result.scale.value == pytest.approx(posed.result.scale.value * measured["factor"])
    assert found.result.scale.spread == measured["spread"] > 0
    # One view says nothing about how far views differ.
    alone = before.depth_z.copy()
    alone[1:] = np.nan
    one = with_measured_depth(with_known_cameras(replace(before, depth_z=alone), known), known, matches)
    assert one.about["measured"]["views"] == 1 and one.result.scale.spread is None


def test_without_points_depth_keeps_the_scale_of_the_cameras_and_says_so(caplog):
    scene = room(views=6, hw=(72, 96), seed=5)
    known = known_of(scene)
    posed = with_known_cameras(predicted(scene), known)
    found = with_measured_depth(posed, known, without_matches(exact_matches(Candidate.of(scene))))
    assert np.array_equal(found.result.depth_z, posed.result.depth_z) and found.about["measured"] is None
    assert "too few points could be measured" in caplog.text


@pytest.mark.parametrize("part", [{"poses": (0, 1, 2, 3)}, {"K": (0,)}])
def test_points_are_measured_with_whole_cameras_only(part):
    scene = room(views=6, hw=(72, 96), seed=5)
    known = known_of(scene, **part)
    assert not is_measurable(with_known_cameras(predicted(scene), known), known)


# -- EXIF data


@pytest.mark.parametrize(("factor", "said"), [(1.0, False), (1.2, False), (1.6, True), (0.5, True)])
def test_focal_lengths_far_from_the_exif_data_are_doubted(tmp_path, caplog, factor, said):
    scene = room(views=4)
    height, width = scene.photo_hw[0].tolist()
    focal = float(scene.photo_K()[0, 0, 0]) * factor
    exif = Image.Exif()
    equivalent = focal / np.hypot(height, width) * np.hypot(36, 24)
    exif.get_ifd(0x8769)[0xA405] = round(equivalent)
    for k in range(4):
        Image.new("RGB", (width, height), (40 * k, 90, 30)).save(tmp_path / f"{k}.jpg", exif=exif)
    doubt_focal_length(scene, freegeo.load_photos(tmp_path))
    assert ("EXIF data" in caplog.text) is said


def poses_of(T: torch.Tensor, *views: int) -> KnownCameras:
    cameras = tuple(KnownCamera(T_cam_world=T[k].numpy() if k in views else None) for k in range(len(T)))
    return KnownCameras(names=tuple(map(str, range(len(T)))), cameras=cameras, source="poses")


def test_frames_between_known_poses_follow_them():
    """A path that drifts evenly away is the true one where its ends are known, and the known poses are exact."""
    true, frames = along(8), [0, 1, 3, 4, 5, 6, 8, 9]
    known, drifted = poses_of(true, 1, 6), drifting(true, frames)
    found = with_poses(drifted, [frames], known, 2.0, None)
    np.testing.assert_array_equal(found.T_cam_world[[1, 6]], true[[1, 6]].numpy())
    np.testing.assert_allclose(found.T_cam_world[1:7], true[1:7].numpy(), atol=1e-9)
    assert found.scale is None and found.about["scale"] == 2
    assert found.about["rotation_deg"] == pytest.approx(np.rad2deg(0.02 * 4.5), rel=1e-3)


def test_no_frame_follows_a_known_pose_on_the_other_side_of_a_cut():
    """Each part is as if it were alone; one without known poses stays where it was placed."""
    true, frames = along(8), [0, 1, 3, 4, 5, 6, 8, 9]
    known, drifted = poses_of(true, 1, 6), drifting(true, frames)
    found = with_poses(drifted, [frames[:3], frames[3:5], frames[5:]], known, 1.0, None).T_cam_world
    first = with_poses(drifted[:3], [frames[:3]], poses_of(true[:3], 1), 1.0, None).T_cam_world
    last = with_poses(drifted[5:], [frames[5:]], poses_of(true[5:], 1), 1.0, None).T_cam_world
    np.testing.assert_array_equal(found, np.concatenate((first, drifted[3:5], last)))


def drifting(true: torch.Tensor, frames: list[int]) -> np.ndarray:
    """Poses that leave the true ones evenly, frame by frame."""
    drifted = []
    for frame, T in zip(frames, true, strict=True):
        centre = camera_centres(T) + frame * torch.tensor([0.02, 0, 0.01], dtype=torch.float64)
        R = T[:3, :3] @ Sim3.exp(torch.tensor([0, 0.02 * frame, 0, 0, 0, 0, 0], dtype=torch.float64)).R
        drifted.append(from_Rt(R, -R @ centre))
    return torch.stack(drifted).numpy()


def test_of_many_photos_only_those_with_known_poses_are_matched(monkeypatch):
    seen = []
    monkeypatch.setattr("freegeo.posed.find_matches", lambda photos, pairs: seen.append((photos, pairs)) or 0)
    monkeypatch.setattr("freegeo.posed.check_convention", lambda known, matches: seen.append(known) or Accepted())
    assert check_known(poses_of(along(18), 2, 9, 17), list(range(18))) is None
    (photos, pairs), known = seen
    assert photos == [2, 9, 17] and len(known) == 3 and known.has_pose.all()
    assert pairs.tolist() == [[0, 1], [0, 2], [1, 2]]


class Accepted:
    sentence = "fine"

    def require(self):
        pass


def test_each_chunk_is_told_the_poses_it_can_take_whatever_the_first_photo_lacks(photos):
    model, known = tiny_mapanything(), known_for(photos)
    known, batch = known.without_poses([0, 1]), model.preprocess(photos)
    assert told(known, batch, model.spec)[0].T_cam_world is None
    priors, sentence = told_in_chunks(known, batch, model.spec)
    assert (
        priors.T_cam_world is not None and f"the poses of {VIEWS - 2} and the intrinsics of {VIEWS} photos" in sentence
    )
