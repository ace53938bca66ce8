import sys

import numpy as np
import pytest

from exact_rooms import PHOTO_SCALE, room
from freegeo.data.procedural import render, sample_rooms
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.colmap import FOLDER, write_colmap
from freegeo.export.formats import check_formats, export
from freegeo.export.pixels import corner_K, corner_pixels
from freegeo.files import LEDGER_FILE, atomic_folder, keep_ledger
from freegeo.fusion.tracks import build_tracks

pycolmap = pytest.importorskip("pycolmap", reason="needs the extra colmap")

VIEWS, HW, SEED, CROP = 5, (60, 80), 7, 6


def tracks_of(scene, **options):
    keep = np.ones(scene.depth_z.shape, bool)
    return build_tracks(scene.depth_z, scene.T_cam_world, scene.K, scene.images, keep, tolerance=0.02, **options)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("colmap")
    files = export(room(VIEWS, HW, SEED, CROP), folder, ["colmap"], max_tracks=4000).files
    assert {f.name for f in files} >= {"cameras.bin", "images.bin", "points3D.bin", "README.txt"}
    assert all(f.is_file() and f.parent in (folder / FOLDER, folder / "colmap") for f in files)
    assert [p.name for p in (folder / FOLDER).parent.iterdir()] == ["0"], "no temporary folder is left"
    return pycolmap.Reconstruction(folder / FOLDER)


@pytest.fixture(scope="module")
def photos():
    """The room rendered at the photos' own resolution: truth that no export code has touched."""
    return render(sample_rooms([SEED], frames=VIEWS), HW[0] * PHOTO_SCALE, HW[1] * PHOTO_SCALE)


def observations(model):
    for number, image in model.images.items():
        for point in image.points2D:
            yield number - 1, image, point


def test_names_sizes_and_poses_are_those_of_the_photos(model, photos):
    assert [model.image(i + 1).name for i in range(VIEWS)] == [f"photo {i}.JPG" for i in range(VIEWS)]
    for i in range(VIEWS):
        camera = model.image(i + 1).camera
        assert (camera.height, camera.width) == (HW[0] * PHOTO_SCALE, HW[1] * PHOTO_SCALE)
        pose = model.image(i + 1).cam_from_world().matrix()
        np.testing.assert_allclose(pose, photos.T_cam_world[0, i, :3].numpy(), atol=1e-5)


def test_intrinsics_are_those_of_the_photos_with_pixel_centres_at_one_half(model, photos):
    for i in range(VIEWS):
        K = photos.K[0, i].numpy()
        expected = (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
        np.testing.assert_allclose(model.image(i + 1).camera.params, expected, rtol=1e-5)


def test_every_point_is_observed_twice_and_reprojects_within_half_a_pixel(model):
    assert model.num_points3D() == 4000
    assert all(point.track.length() >= 2 for point in model.points3D.values())
    assert all(len({e.image_id for e in p.track.elements}) == p.track.length() for p in model.points3D.values())
    errors = [
        np.linalg.norm(image.project_point(model.point3D(point.point3D_id).xyz) - point.xy)
        for _, image, point in observations(model)
    ]
    assert len(errors) >= 2 * model.num_points3D()
    assert np.mean(errors) < 0.5
    assert max(errors) <= 4 * PHOTO_SCALE
    assert model.compute_mean_reprojection_error() == pytest.approx(np.mean(errors), abs=0.01)


def test_observations_lie_on_the_point_in_the_photo(model, photos):
    depth_z, agreeing, total = photos.depth_z[0].numpy(), 0, 0
    for view, image, point in observations(model):
        xyz = image.cam_from_world() * model.point3D(point.point3D_id).xyz
        column, row = np.floor(point.xy).astype(int)
        agreeing += abs(depth_z[view, row, column] / xyz[2] - 1) < 0.03
        total += 1
    assert agreeing / total > 0.98


def test_colours_are_those_of_the_image(model):
    scene = room(VIEWS, HW, SEED, CROP)
    view, row, column = 2, 30, 40
    tracks = tracks_of(scene)
    at = (tracks.view == view) & (tracks.pixel == (column, row)).all(-1)
    own = [
        i for i in np.flatnonzero(at) if (tracks.view[: i + 1][tracks.point[: i + 1] == tracks.point[i]] == view).all()
    ]
    for i in own:
        np.testing.assert_array_equal(tracks.colours[tracks.point[i]], scene.images[view, row, column])
    seen = {tuple(p.color) for p in model.points3D.values()}
    assert seen <= {tuple(c) for c in scene.images.reshape(-1, 3)}


def test_bundle_adjustment_runs_and_stays(model):
    before = {i: image.projection_center() for i, image in model.images.items()}
    adjusted = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    pycolmap.bundle_adjustment(adjusted, options)
    adjusted.update_point_3d_errors()
    assert adjusted.num_points3D() == model.num_points3D()
    assert adjusted.compute_mean_reprojection_error() <= model.compute_mean_reprojection_error() + 1e-3
    moved = [np.linalg.norm(adjusted.image(i).projection_center() - centre) for i, centre in before.items()]
    assert max(moved) < 0.02


def test_tracks_show_how_well_the_views_agree():
    exact, noisy = room(VIEWS, HW, SEED), room(VIEWS, HW, SEED)
    noise = np.random.default_rng(0).normal(1, 0.005, (VIEWS, 1, 1)).astype(np.float32)
    noisy = type(noisy)(**{**vars(noisy), "depth_z": noisy.depth_z * noise})

    def error(scene):
        tracks = tracks_of(scene)
        T, K = scene.T_cam_world[tracks.view].astype(float), scene.K[tracks.view].astype(float)
        camera = np.einsum("nij,nj->ni", T[:, :3, :3], tracks.xyz[tracks.point]) + T[:, :3, 3]
        pixel = np.einsum("nij,nj->ni", K, camera)
        return np.linalg.norm(pixel[:, :2] / pixel[:, 2:] - tracks.pixel, axis=-1)

    assert error(exact).mean() < 0.02
    assert error(noisy).mean() > 3 * error(exact).mean()
    assert error(noisy).max() <= 4.0


def test_the_corner_rule_undoes_resize_and_crop():
    scene = room(VIEWS, HW, SEED, CROP)
    places = corner_pixels(scene, np.zeros(1, np.int64), np.array([[-0.5, -0.5]]))
    np.testing.assert_allclose(places, [[CROP * PHOTO_SCALE, 0.0]])
    direction = np.linalg.inv(scene.K[0].astype(float)) @ (3, 4, 1)
    through = corner_K(scene)[0] @ direction
    np.testing.assert_allclose(
        through[:2] / through[2], corner_pixels(scene, np.zeros(1, np.int64), np.array([[3, 4]]))[0], rtol=1e-6
    )


@pytest.mark.parametrize("noted", [False, True])
def test_a_model_replaces_the_one_before_and_spares_other_files(tmp_path, noted):
    if noted:
        keep_ledger(tmp_path)
    scene = room(VIEWS, HW, SEED, CROP)
    first = write_colmap(scene, tracks_of(scene, max_points=50), tmp_path / "0")
    (tmp_path / "0" / "project.ini").write_text("mine")
    again = write_colmap(scene, tracks_of(scene, max_points=20), tmp_path / "0")
    assert pycolmap.Reconstruction(tmp_path / "0").num_points3D() == 20
    assert again == first
    assert set((tmp_path / "0").iterdir()) == {*again, tmp_path / "0" / "project.ini"}
    assert {p.name for p in tmp_path.iterdir()} == {"0"} | ({LEDGER_FILE} if noted else set())


def test_files_that_an_older_pycolmap_wrote_do_not_mix_with_new_ones(tmp_path):
    keep_ledger(tmp_path)
    with atomic_folder(tmp_path / "0") as part:
        (part / "points.old").write_text("")
    scene = room(VIEWS, HW, SEED, CROP)
    new = write_colmap(scene, tracks_of(scene, max_points=20), tmp_path / "0")
    assert set((tmp_path / "0").iterdir()) == set(new)


@pytest.mark.parametrize("measured", [False, True])
def test_the_export_says_what_its_observations_are(tmp_path, caplog, measured):
    caplog.set_level("INFO")
    scene = room(VIEWS, HW, SEED, CROP)
    export(scene, tmp_path, ["colmap"], max_tracks=20, tracks=tracks_of(scene, max_points=30) if measured else None)
    for text in (caplog.text, (tmp_path / "colmap" / "README.txt").read_text()):
        assert ("observations are measured matches" in text.lower()) == measured
        assert ("observations are re-projections of the prediction" in text.lower()) != measured
        assert ("bundle adjustment" in text.lower() and "cannot improve" in text) != measured
    assert len(pycolmap.Reconstruction(tmp_path / "colmap/sparse/0").points3D) == 20


def test_measured_points_keep_to_the_masks(tmp_path):
    scene = room(VIEWS, HW, SEED, CROP)
    masks = np.ones(scene.depth_z.shape, bool)
    masks[0, :, : masks.shape[2] // 2] = False
    tracks = tracks_of(scene, max_points=200)
    export(scene, tmp_path, ["colmap"], tracks=tracks, masks=masks)
    model = pycolmap.Reconstruction(tmp_path / "colmap/sparse/0")
    left = corner_pixels(scene, np.zeros(1, np.int64), np.array([[masks.shape[2] / 2 - 0.5, 0.0]]))[0, 0]
    seen = [p.xy[0] for p in model.images[1].points2D if p.has_point3D()]
    assert 0 < len(model.points3D) < len(tracks)
    assert min(seen) >= left


def test_failures_are_one_sentence_and_leave_nothing(tmp_path, monkeypatch):
    scene = room(VIEWS, HW, SEED, CROP)
    nothing = build_tracks(
        scene.depth_z, scene.T_cam_world, scene.K, scene.images, np.zeros(scene.depth_z.shape, bool), tolerance=0.02
    )
    with pytest.raises(FreeGeoError, match="no point is seen by two views"):
        write_colmap(scene, nothing, tmp_path / "0")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(FreeGeoError, match=r"pip install 'freegeo\[colmap\]'"):
        write_colmap(scene, tracks_of(scene, max_points=20), tmp_path / "0")
    with pytest.raises(UserError, match=r"pip install 'freegeo\[colmap\]'"):
        check_formats(["ply", "colmap"], scene.names)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="limits of a process")
def test_a_disk_that_is_full_is_an_error_though_pycolmap_does_not_notice(tmp_path):
    """The limit stands for a disk on which the model fits, but hardly."""
    import resource

    scene, before = room(VIEWS, HW, SEED, CROP), resource.getrlimit(resource.RLIMIT_FSIZE)
    tracks = tracks_of(scene, max_points=20)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 19, before[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            write_colmap(scene, tracks, tmp_path / "0")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
