"""Every format is read as it is documented; each wrong reading of each is refused, with the one that fits."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest

from cameras.conftest import write
from freegeo.cameras import colmap, nerfstudio, plain, trajectories
from freegeo.cameras.convention import READINGS, check_convention
from freegeo.cameras.formats import FORMATS, choose_format
from freegeo.cameras.known import KnownCamera, KnownCameras, Lens
from freegeo.cameras.reading import read_camera_file, read_cameras
from freegeo.data import colmap_files
from freegeo.data.photos import MemoryPhoto
from freegeo.errors import UserError

NAMES = list(FORMATS)
WRITERS = [name for name, format in FORMATS.items() if format.write is not None]
LENSES = [
    Lens("SIMPLE_RADIAL", (-0.1,)),
    Lens("RADIAL", (-0.1, 0.02)),
    Lens("OPENCV", (-0.1, 0.02, 0.001, -0.002)),
    Lens("OPENCV_FISHEYE", (0.01, -0.02, 0.003, 0.0001)),
    Lens("FULL_OPENCV", (-0.1, 0.02, 0.001, -0.002, 0.01, 0.02, 0.03, 0.04)),
]


def poses(known: KnownCameras) -> np.ndarray:
    return np.stack([one.T_cam_world for one in known.cameras])


def same(one: KnownCamera, other: KnownCamera, tolerance: float = 1e-12) -> bool:
    """Whether two cameras are the same, distortion and numbers exactly."""
    pose = np.allclose(one.T_cam_world, other.T_cam_world, rtol=0, atol=tolerance)
    return pose and np.allclose(one.K, other.K, rtol=0, atol=tolerance) and (one.lens, one.size_hw, one.ids) == (
        other.lens, other.size_hw, other.ids,
    )  # fmt: skip


@pytest.mark.parametrize("format", NAMES)
def test_a_format_is_told_by_its_content_and_read_as_documented(format, known, scene, tmp_path):
    written = write(format, known, tmp_path, FORMATS[format].reading)
    assert choose_format(written.path)[0].name == format
    read = read_cameras(written.path, scene.photos)
    assert read.names == known.names
    assert read.convention == FORMATS[format].reading
    np.testing.assert_allclose(poses(read), poses(known), rtol=0, atol=1e-12)
    assert read.has_K.all() == written.has_K
    if written.has_K:
        assert all(np.allclose(a.K, b.K, rtol=0, atol=1e-10) for a, b in zip(read.cameras, known.cameras, strict=True))


@pytest.mark.parametrize("format", NAMES)
def test_every_wrong_reading_is_refused_and_the_right_one_is_named(format, known, scene, matches, tmp_path):
    documented = FORMATS[format].reading
    for reading in READINGS:
        written = write(format, known, tmp_path / reading, reading)
        read = read_cameras(written.path, scene.photos)
        found = check_convention(read, matches, K=np.stack([one.K for one in known.cameras]))
        assert found.outcome == ("accepted" if reading == documented else "refused"), found.sentence
        if reading != documented:
            with pytest.raises(UserError, match=f"they fit as {READINGS[reading]} .*--cameras-convention {reading}"):
                found.require()
            assert all(f"{what} " in found.sentence for what in READINGS.values())
        told = read_cameras(written.path, scene.photos, convention=reading)
        assert told.convention == reading
        np.testing.assert_allclose(poses(told), poses(known), rtol=0, atol=1e-12)


@pytest.mark.parametrize("format", WRITERS)
def test_what_is_written_is_read_back(format, known, scene, tmp_path):
    path = tmp_path / ("model" if format == "colmap" else "file.json" if "json" in format else "file")
    path = path.with_suffix(".json") if format == "nerfstudio" else path
    FORMATS[format].write(known, path)
    assert choose_format(path)[0].name == format
    read = read_cameras(path, scene.photos)
    np.testing.assert_allclose(poses(read), poses(known), rtol=0, atol=1e-12)
    if format not in ("tum", "kitti"):
        assert all(np.allclose(a.K, b.K, rtol=0, atol=1e-12) for a, b in zip(read.cameras, known.cameras, strict=True))


def test_cameras_json_holds_everything_and_any_part(known, tmp_path):
    full = KnownCamera(
        T_cam_world=known.cameras[0].T_cam_world, K=known.cameras[0].K, lens=LENSES[2], size_hw=(144, 192), ids=(5, 2)
    )
    parts = (full, KnownCamera(K=full.K), KnownCamera(T_cam_world=known.cameras[1].T_cam_world), KnownCamera())
    some = KnownCameras(names=("a", "b", "c", "d"), cameras=parts, source="", metric=True)
    plain.write(some, tmp_path / "cameras.json")
    read = read_camera_file(tmp_path / "cameras.json")
    assert read.metric
    assert same(read.cameras[0], full)
    assert read.has_pose.tolist() == [True, False, True, False]
    assert read.has_K.tolist() == [True, True, False, False]


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_colmap_survives_a_way_through_cameras_json(lens, known, tmp_path):
    cameras = [
        replace(
            one,
            lens=lens if k % 2 else None,
            ids=(10 + k, 4 + k % 2),
            K=np.array([[200.0, 0, 96], [0, 200, 72], [0, 0, 1]]),
        )
        for k, one in enumerate(known.cameras)
    ]
    names = tuple(f"cam {k % 2}/shot {k}.jpg" for k in range(len(known)))
    model = replace(known, names=names, cameras=tuple(cameras))
    colmap.write(model, tmp_path / "one")
    plain.write(read_camera_file(tmp_path / "one"), tmp_path / "cameras.json")
    colmap.write(read_camera_file(tmp_path / "cameras.json"), tmp_path / "two")
    back = read_camera_file(tmp_path / "two")
    assert back.names == names
    assert all(same(a, b, 1e-9) for a, b in zip(back.cameras, cameras, strict=True))
    assert set(colmap_files.read_cameras(tmp_path / "two")) == {4, 5}


def test_a_model_that_colmap_itself_wrote_with_rigs_and_frames(known, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    params = [200.0, 201.0, 96.0, 72.0, -0.1, 0.02, 0.001, -0.002]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="OPENCV", width=192, height=144, params=params, camera_id=3)
    )
    for k, one in enumerate(known.cameras):
        image = pycolmap.Image(name=f"sub/{k}.jpg", keypoints=np.zeros((k, 2)), camera_id=3, image_id=k + 5)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(one.T_cam_world[:3]))
    for kind in ("binary", "text"):
        folder = tmp_path / kind / "sparse" / "0"
        folder.mkdir(parents=True)
        getattr(model, f"write_{kind}")(str(folder))
        assert (folder / f"frames.{'bin' if kind == 'binary' else 'txt'}").is_file()
        for place in (folder, tmp_path / kind, tmp_path / kind / "sparse", next(folder.glob("images.*"))):
            read = read_camera_file(place)
            order = [read.names.index(f"sub/{k}.jpg") for k in range(len(known))]
            chosen = read.select(order)
            np.testing.assert_allclose(poses(chosen), poses(known), rtol=0, atol=1e-9)
            assert chosen.cameras[2].lens == Lens("OPENCV", tuple(params[4:]))
            assert [one.ids for one in chosen.cameras] == [(k + 5, 3) for k in range(len(known))]
    again = tmp_path / "again"
    colmap.write(read_camera_file(folder), again)
    loaded = pycolmap.Reconstruction(str(again))
    for k, one in enumerate(known.cameras):
        image = loaded.image(k + 5)
        assert (image.name, image.camera_id) == (f"sub/{k}.jpg", 3)
        np.testing.assert_allclose(image.cam_from_world().matrix(), one.T_cam_world[:3], rtol=0, atol=1e-9)
    assert list(loaded.camera(3).params) == params


def test_a_project_with_several_models_is_asked_for_one(known, tmp_path):
    for number in (0, 1):
        colmap.write(known, tmp_path / "sparse" / str(number))
    with pytest.raises(UserError, match=r"several COLMAP models.*sparse/0.*sparse/1"):
        read_camera_file(tmp_path)
    assert len(read_camera_file(tmp_path / "sparse" / "1")) == len(known)


def test_one_focal_length_that_a_resize_split_is_written_with_two(known, tmp_path):
    K = np.array([[200.0, 0, 96], [0, 201, 72], [0, 0, 1]])
    cameras = tuple(replace(one, K=K, lens=Lens("RADIAL", (-0.1, 0.02))) for one in known.cameras)
    colmap.write(replace(known, cameras=cameras), tmp_path / "model")
    read = read_camera_file(tmp_path / "model").cameras[0]
    np.testing.assert_array_equal(read.K, K)
    assert read.lens == Lens("OPENCV", (-0.1, 0.02, 0.0, 0.0))


def transforms(tmp_path, known, **values):
    """A transforms.json of two frames whose values are overridden."""
    frame = values.pop("frame", {})
    matrices = [T.tolist() for T in np.linalg.inv(poses(known)[:2])]
    frames = [{"file_path": f"images/{k:02d}.png", "transform_matrix": T} for k, T in enumerate(matrices)]
    frames[1] |= frame
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": frames, **values}))
    return path


def test_values_of_a_frame_override_those_of_the_file(known, tmp_path):
    shared = {"w": 192, "h": 144, "fl_x": 200, "fl_y": 210, "cx": 95, "cy": 70, "k1": -0.1, "p2": 0.01}
    path = transforms(tmp_path, known, **shared, frame={"fl_x": 300, "k1": 0.2, "k2": 0.1})
    first, second = read_camera_file(path).cameras
    np.testing.assert_array_equal(first.K, [[200, 0, 95], [0, 210, 70], [0, 0, 1]])
    np.testing.assert_array_equal(second.K, [[300, 0, 95], [0, 210, 70], [0, 0, 1]])
    assert (first.lens, second.lens) == (Lens("OPENCV", (-0.1, 0, 0, 0.01)), Lens("OPENCV", (0.2, 0.1, 0, 0.01)))


def test_a_field_of_view_becomes_a_focal_length_with_the_size_of_the_photo(known, scene, tmp_path):
    path = transforms(tmp_path, known, camera_angle_x=1.0)
    with pytest.raises(UserError, match=r"field of view and no size.*--photos"):
        read_camera_file(path)
    read = read_cameras(path, scene.photos[:2])
    focal = 96 / np.tan(0.5)
    np.testing.assert_allclose(read.cameras[0].K, [[focal, 0, 96], [0, focal, 72], [0, 0, 1]])
    sized = read_camera_file(transforms(tmp_path, known, camera_angle_x=1.0, w=384, h=288)).cameras[0]
    np.testing.assert_allclose(sized.K, [[2 * focal, 0, 192], [0, 2 * focal, 144], [0, 0, 1]])


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_distortion_through_transforms_json_bends_the_same(lens, known, tmp_path):
    cameras = tuple(replace(one, lens=lens) for one in known.cameras)
    path = tmp_path / "transforms.json"
    if lens.model == "FULL_OPENCV":
        with pytest.raises(UserError, match=r"no place for the distortion of FULL_OPENCV"):
            nerfstudio.write(replace(known, cameras=cameras), path)
        lens = Lens("FULL_OPENCV", (*lens.params[:5], 0.0, 0.0, 0.0))
        cameras = tuple(replace(one, lens=lens) for one in known.cameras)
    nerfstudio.write(replace(known, cameras=cameras), path)
    read = read_camera_file(path).cameras[0].lens
    if lens.model in ("SIMPLE_RADIAL", "RADIAL"):
        lens = Lens("OPENCV", (*lens.params, *[0.0] * (4 - len(lens.params))))
    assert read == lens


def test_time_stamps_are_names_or_else_an_order(known, scene, tmp_path):
    photos = [replace_name(photo, f"{1305031102.25 + k}.png") for k, photo in enumerate(scene.photos)]
    stamped = replace(known, names=tuple(photo.name for photo in photos))
    trajectories.write_tum(stamped, tmp_path / "t.txt")
    assert "1305031104.25 " in (tmp_path / "t.txt").read_text()
    turned = list(reversed(photos))[:4]
    read = read_cameras(tmp_path / "t.txt", turned)
    np.testing.assert_allclose(poses(read), poses(known)[::-1][:4], rtol=0, atol=1e-12)
    # Counting from 1 in the names and from 0 in the file: the order is right, the numbers are not.
    ones = [replace_name(photo, f"{k + 1:04d}.png") for k, photo in enumerate(scene.photos)]
    counted = write("tum", known, tmp_path / "c", "c2w-opencv").path
    np.testing.assert_allclose(poses(read_cameras(counted, ones)), poses(known), rtol=0, atol=1e-12)


def replace_name(photo, name: str) -> MemoryPhoto:
    return MemoryPhoto(name, photo.pixels)


# -- what cannot be used: one sentence each


def json_frames(change):
    def spoil(path):
        content = json.loads(path.read_text())
        change(content["frames"])
        path.write_text(json.dumps(content))

    return spoil


def pose_with(change):
    def spoil(frames):
        for frame in frames[1:2]:
            T = np.array(frame["w2c"])
            change(T)
            frame["w2c"] = T.tolist()

    return json_frames(spoil)


def K_with(row: int, column: int, value: float):
    return json_frames(lambda frames: frames[1]["K"][row].__setitem__(column, value))


def put(T, where, value):
    T[where] = value


SPOILT = {
    "mirrored axes": (pose_with(lambda T: put(T, 0, -T[0])), r"01.png has mirrored axes \(determinant -1\)"),
    "pose not a number": (pose_with(lambda T: put(T, (0, 3), np.nan)), "01.png has a pose that is not finite"),
    "infinite pose": (pose_with(lambda T: put(T, (2, 2), -np.inf)), "01.png has a pose that is not finite"),
    "scaled rotation": (pose_with(lambda T: put(T, np.s_[:3, :3], 2.5 * T[:3, :3])), "is scaled by 2.5"),
    "no rotation": (pose_with(lambda T: put(T, (0, 0), T[0, 0] + 0.3)), "left part is no rotation"),
    "zero pose": (pose_with(lambda T: put(T, np.s_[:3, :3], 0)), "left part is no rotation"),
    "transposed pose": (pose_with(lambda T: put(T, ..., T.T.copy())), "last row is not 0 0 0 1; is the matrix transp"),
    "zero focal length": (K_with(0, 0, 0.0), "focal length that is not positive"),
    "negative focal length": (K_with(1, 1, -200.0), r"focal length that is not positive \(-200\)"),
    "shares of the image": (K_with(0, 0, 0.9), "0.9 for an image of 192 x 144: give intrinsics in pixels"),
    "skew": (K_with(0, 1, 9.0), "skewed pixels"),
    "K not a number": (K_with(0, 2, float("nan")), "intrinsics that are not finite"),
    "no K": (K_with(2, 2, 2.0), "intrinsics that are not"),
    "principal point outside": (K_with(0, 2, 400.0), r"principal point \(400.0, 72.0\) outside the image of 192 x 144"),
    "listed twice": (json_frames(lambda frames: frames.append(frames[0])), "00.png is listed twice"),
    "one pose for all": (json_frames(lambda f: [one.update(w2c=f[0]["w2c"]) for one in f]), "all 5 cameras have"),
    "ragged matrix": (json_frames(lambda f: f[1].update(w2c=[[1, 0], [0]])), "01.png: w2c is not a matrix of 4 x 4"),
    "unknown key": (json_frames(lambda f: f[1].update(k1=0.1)), "01.png has the unknown key k1"),
    "half a size": (json_frames(lambda f: f[1].pop("width")), "height and width must both be whole numbers"),
    "no frames": (json_frames(lambda f: f.clear()), "no list of frames"),
    "unknown lens": (
        json_frames(lambda f: f[1].update(lens={"model": "FOV", "params": [0.9]})), "of the model FOV cannot be undist",
    ),
    "numbers of a lens": (
        json_frames(lambda f: f[1].update(lens={"model": "RADIAL", "params": [0.1]})), "RADIAL has 2 finite numbers",
    ),
    "lens alone": (
        json_frames(lambda f: (f[1].update(lens={"model": "RADIAL", "params": [0.1, 0]}), f[1].pop("K"))),
        "distortion without intrinsics",
    ),
    "broken": (lambda path: path.write_text(path.read_text()[:-30]), "broken JSON"),
    "empty": (lambda path: path.write_text(""), "the file is empty"),
    "list": (lambda path: path.write_text("[]"), "holds no JSON object"),
    "something else": (lambda path: path.write_text('{"a": 1}'), "holds no cameras of a known format"),
    "binary": (lambda path: path.write_bytes(b"\xff\xfe\x00"), "not a text file"),
}  # fmt: skip


@pytest.mark.parametrize("kind", SPOILT)
def test_what_cannot_be_used_is_refused_in_one_sentence(kind, known, scene, tmp_path):
    spoil, words = SPOILT[kind]
    path = write("cameras.json", known, tmp_path, "w2c-opencv").path
    spoil(path)
    named = "cameras.json" if kind == "no frames" else None
    with pytest.raises(UserError, match=words) as error:
        read_cameras(path, scene.photos, format=named)
    assert str(error.value).startswith(str(path))


def spoilt_colmap(folder, name, old, new):
    file = folder / name
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("cameras.txt", "PINHOLE", "FANCY", "unknown camera model FANCY"),
        ("cameras.txt", "PINHOLE", "OPENCV", "OPENCV has 8 parameters, not 4"),
        ("cameras.txt", "7 PINHOLE", "8 PINHOLE", "00.png has the camera 7, which is not listed"),
        ("cameras.txt", "PINHOLE", "THIN_PRISM_FISHEYE", "THIN_PRISM_FISHEYE has 12 parameters"),
        ("images.txt", " 7 01.png\n\n", " 7 01.png\n", "the line after image 01.png is not one of its points"),
        ("images.txt", " 7 01.png", " 7 00.png", "00.png is listed twice"),
        ("images.txt", " 7 01.png", " x 01.png", "not a readable COLMAP file"),
    ],
)
def test_colmap_files_that_cannot_be_used(name, old, new, words, known, scene, tmp_path):
    folder = write("colmap", known, tmp_path, "w2c-opencv").path
    spoilt_colmap(folder, name, old, new)
    with pytest.raises(UserError, match=words):
        read_cameras(folder, scene.photos)


def test_colmap_lenses_that_cannot_be_undistorted_are_refused(known, scene, tmp_path):
    folder = write("colmap", known, tmp_path, "w2c-opencv").path
    (folder / "cameras.txt").write_text("7 RADIAL_FISHEYE 192 144 200 96 72 0.1 0.2\n")
    with pytest.raises(
        UserError, match=r"RADIAL_FISHEYE cannot be undistorted; known are SIMPLE_RADIAL, .* and pinhol"
    ):
        read_cameras(folder, scene.photos)


def test_a_colmap_model_without_images_or_with_an_unknown_number_of_a_model(tmp_path):
    (tmp_path / "images.txt").write_text("# none\n")
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 10 10 1 1 5 5\n")
    with pytest.raises(UserError, match=r"no image with a pose"):
        read_camera_file(tmp_path)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 0))
    for number in (-1, 40):
        (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, number, 10, 10, 1, 1, 5, 5))
        with pytest.raises(UserError, match=f"camera 1 has the unknown model {number}"):
            read_camera_file(tmp_path)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model EQUIRECTANGULAR is not known"),
        ({"fl_x": "200"}, "fl_x is '200', which is no number"),
        ({"fl_x": 200}, "neither a principal point .cx, cy. nor a size"),
        ({"camera_angle_x": 4.0, "w": 192, "h": 144}, "camera_angle_x is 4"),
        ({"camera_angle_x": 4.0}, "field of view of 4, which is not between"),
        ({"fl_x": 200, "w": 192, "h": 144, "k4": 0.1}, "k4, k5 or k6"),
        ({"fl_x": 200, "w": 192, "h": 144, "camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "fisheye has no p1"),
        ({"fl_x": 200, "w": 192, "h": 144, "frame": {"transform_matrix": [1]}}, "transform_matrix is not a matrix"),
        ({"fl_x": 200, "w": 192, "h": 144, "frame": {"file_path": None}}, "a frame has no file_path"),
    ],
)
def test_transforms_json_that_cannot_be_used(values, words, known, scene, tmp_path):
    with pytest.raises(UserError, match=words):
        read_cameras(transforms(tmp_path, known, **values), scene.photos[:2])


@pytest.mark.parametrize(
    ("format", "text", "words"),
    [
        ("tum", "1 2 3\n", "row 1 has 3 numbers, and a TUM trajectory has 8"),
        ("tum", "1 0 0 0 0 0 0 1\n1 0 0 1 0 0 0 1\n", "1.0 is listed twice"),
        ("tum", "1 0 0 0 0 0 0 0\n", "quaternion at the time 1 does not have the length 1"),
        ("kitti", "1 0 0 0 0 1 0 0 0 0 1 0\n1 2\n", "row 2 has 2 numbers, and a KITTI trajectory has 12"),
        ("kitti", "a b c\n", "not a table of numbers"),
        ("kitti", "", "the file is empty"),
    ],
)
def test_trajectories_that_cannot_be_used(format, text, words, scene, tmp_path):
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(UserError, match=words):
        read_cameras(tmp_path / "t.txt", scene.photos, format=format)


def test_poses_without_names_need_as_many_photos(known, scene, tmp_path):
    path = write("kitti", known, tmp_path, "c2w-opencv").path
    with pytest.raises(UserError, match=r"5 poses without names for 4 photos.*--max-views"):
        read_cameras(path, scene.photos[:4])
    with pytest.raises(UserError, match=r"5 time stamps such as 0.0, of which none is the name of one of the 2 photos"):
        read_cameras(write("tum", known, tmp_path / "t", "c2w-opencv").path, named(scene, ["a.png", "b.png"]))


def named(scene, names):
    return [replace_name(photo, name) for photo, name in zip(scene.photos, names, strict=False)]


def test_a_pose_file_that_is_no_matrix_is_named(known, scene, tmp_path):
    folder = write("poses", known, tmp_path, "c2w-opencv").path
    (folder / "03.pose.txt").write_text("1 0 0 0\n0 1 0 0\n")
    with pytest.raises(UserError, match=r"03.pose.txt: has 2 rows, and a pose has 4 rows of 4 numbers"):
        read_cameras(folder, scene.photos)


def test_a_format_can_be_named_and_an_unknown_one_is_refused(known, scene, tmp_path):
    path = write("kitti", known, tmp_path, "c2w-opencv").path
    assert len(read_cameras(path, scene.photos, format="kitti")) == len(known)
    with pytest.raises(UserError, match=r"bundler: no format of cameras. Choose one of cameras.json, colmap"):
        read_cameras(path, scene.photos, format="bundler")
    with pytest.raises(UserError, match=r"no reading of poses"):
        read_cameras(path, scene.photos, convention="c2w")
    with pytest.raises(UserError, match=r"no such file or folder of cameras"):
        read_cameras(tmp_path / "nowhere", scene.photos)


def test_a_folder_that_holds_two_kinds_is_asked_for_one(known, tmp_path):
    write("cameras.json", known, tmp_path, "w2c-opencv")
    write("nerfstudio", known, tmp_path, "c2w-opengl")
    with pytest.raises(UserError, match=r"several kinds.*cameras.json.*transforms.json"):
        read_camera_file(tmp_path)
    assert len(read_camera_file(tmp_path, format="nerfstudio")) == len(known)
