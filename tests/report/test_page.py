import base64
import dataclasses
import html
import io
import json
import re

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from exact_rooms import room
from example_results import HOSTILE_NAME, finer_photos, write_example
from example_sequences import ring
from freegeo import files
from freegeo.data.photos import MemoryPhoto
from freegeo.export.colours import INVALID_GREY, log_colours, log_range
from freegeo.export.formats import export
from freegeo.export.kept import save_kept
from freegeo.export.reconstruction import METRIC_MODEL, Reconstruction, Scale
from freegeo.fusion.filtering import FilterReport
from freegeo.fusion.settings import FilterSettings
from freegeo.job import before_adaptation, write_files
from freegeo.report import figures, page, scene3d
from freegeo.report.contents import FILES, contents
from freegeo.report.page import flattened, score_table, views, write_report
from freegeo.report.rendering import marked
from freegeo.report.result import load_result


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    folder = write_example(tmp_path_factory.mktemp("page") / "out <i>", names=(HOSTILE_NAME,))
    return write_report(folder).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    result = load_result(write_example(tmp_path_factory.mktemp("scene") / "out"))
    return result, scene3d.scene_data(result)


def test_the_page_refers_to_nothing_outside(example):
    without_namespaces = re.sub(r'xmlns(:\w+)?="[^"]*"', "", example)
    links = re.search(r'<section id="files">.*?</section>', without_namespaces, re.DOTALL)[0]
    assert not re.search(r"(src|href)\s*=\s*[\"'](?!data:|#)", without_namespaces.replace(links, ""))
    assert not re.search(r"https?://|@import|url\((?!#|[\"']?#)", without_namespaces)
    assert "default-src 'none'" in example
    assert len(example) < 1_500_000


def test_names_and_texts_are_escaped(example):
    assert html.escape(HOSTILE_NAME, quote=False).replace('"', "&#34;") in example
    assert HOSTILE_NAME not in example
    assert "<script>window.broken" not in example
    assert "out &lt;i&gt;" in example
    assert "Apache-2.0 &lt;weights&gt;" in example
    assert "freegeo run &#39;my photos&#39; -o out" in example


def test_warnings_of_the_summary_stand_at_the_top(tmp_path):
    folder = write_example(tmp_path / "out")
    plain = write_report(folder).read_text(encoding="utf-8")
    summary = files.read_json(folder / "reconstruction.json")
    files.write_json(
        folder / "reconstruction.json", {**summary, "warnings": ["Half of <b>a.png</b> is cut off: `freegeo export`."]}
    )
    page = write_report(folder).read_text(encoding="utf-8")
    assert 'class="warnings"' not in plain
    assert page.index("Half of &lt;b&gt;a.png&lt;/b&gt; is cut off: <code>freegeo export</code>.") < page.index(
        "<main>"
    )


@pytest.mark.parametrize(
    ("sentence", "shown"),
    [
        ("run `freegeo adapt <x>` again", "run <code>freegeo adapt &lt;x&gt;</code> again"),
        ("`<script>`, `b`", "<code>&lt;script&gt;</code>, <code>b</code>"),
        ("one ` alone", "one ` alone"),
        ("``", "``"),
        ("</code>`a`", "&lt;/code&gt;<code>a</code>"),
    ],
)
def test_what_stands_between_backticks_is_code_and_escaped(sentence, shown):
    assert marked(sentence) == shown


def test_the_verdict_comes_first(tmp_path):
    folder = write_example(tmp_path / "out", truth=False)
    summary = files.read_json(folder / "reconstruction.json")
    told = {"accepted": False, "reason": "Too few pairs."}
    files.write_json(folder / "reconstruction.json", {**summary, "warnings": ["A doubt."], "refinement": told})
    text = write_report(folder).read_text(encoding="utf-8")
    places = [text.index(part) for part in ("<h1>", "Refinement: no.", "A doubt.", '<dl class="facts">', "<main>")]
    assert places == sorted(places)


def test_without_a_verdict_the_page_says_what_it_shows(tmp_path):
    room(2).save(tmp_path)
    for summary, sentence in (
        ({}, "Nothing is known of how"),
        ({"adapter": None}, "neither adapted to these photos nor refined"),
        ({"adapter": "elsewhere/adapter"}, "Predicted with the adapter elsewhere/adapter."),
    ):
        assert sentence in page.unasked(dataclasses.replace(load_result(tmp_path), summary=summary))


def test_links_name_what_is_there_and_nothing_else(tmp_path):
    folder = write_example(tmp_path / "out")
    (folder / "depth").mkdir()
    text = write_report(folder).read_text(encoding="utf-8")
    links = re.findall(r'<li><a href="([^"]*)">', text)
    assert set(links) == {"depth/", "prediction.npz", "frozen/prediction.npz", "adapter/", "reconstruction.json"}
    assert all((folder / link).exists() for link in links)


def test_photos_are_shown_as_the_model_saw_them_but_finer(tmp_path):
    # A photo of 80 x 120 of which the model read, at an eighth of the size, all rows and the middle, and padding above.
    photo = np.random.default_rng(0).integers(0, 256, (10, 15, 3), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
    model = np.full((12, 11, 3), 255, np.uint8)
    model[2:] = photo[::8, ::8][:, 2:13]
    seen = dataclasses.replace(
        room(1, (12, 11)), images=model[None], photo_hw=np.array([[80, 120]]), scale_xy=np.full((1, 2), 1 / 8),
        offset_xy=np.array([[-2.0, 2.0]]),
    )  # fmt: skip
    found = figures.photo_as_seen(photo, seen, 0, 1000)
    assert found.shape == (96, 88, 3), "no finer than the photo is"
    assert np.array_equal(found[4::8, 4::8], model)
    assert max(figures.photo_as_seen(photo, seen, 0, 48).shape) == 48
    folder = write_example(tmp_path / "out", truth=False)
    photos = finer_photos(folder)
    (first, *_) = views(load_result(folder), photos)
    header = base64.b64decode(first["pictures"][0][2].partition(",")[2])
    with Image.open(io.BytesIO(header)) as picture:
        assert picture.size == (640, 480)


def test_a_frozen_prediction_beside_known_cameras_is_called_what_it_is(tmp_path):
    folder = write_example(tmp_path / "out", truth=False)
    summary = files.read_json(folder / "reconstruction.json")
    known = {"source": "cameras.json", "poses": 4, "intrinsics": 4, "metric": False}
    scale = {"value": 2.5, "source": "a measured distance", "spread": None}
    files.write_json(folder / "reconstruction.json", {**summary, "known_cameras": known, "scale": scale})
    result = load_result(folder)
    assert [stage.label for stage in result.predictions] == ["frozen, own cameras", "adapted"]
    text = write_report(folder).read_text(encoding="utf-8")
    assert "what differs from it is not the adaptation alone" in text
    assert "adapted, from frozen, own cameras" in text
    assert "4 poses, 4 intrinsics, positions times 2.5" in text
    for facts, label in (
        ({"known_cameras": known}, "frozen, own cameras"),
        ({"one_camera": {}}, "frozen"),
        ({}, "frozen"),
    ):
        shown = before_adaptation(folder, {"known_cameras": None, "one_camera": None, **facts})
        assert shown.label == label, "in the fly-through as in the report"


def test_the_list_of_files_stays_true_when_depth_of_another_size_is_exported(tmp_path):
    folder = write_example(tmp_path / "out", truth=False)
    result = Reconstruction.load(folder)
    photos = [MemoryPhoto(n, np.zeros((*hw, 3), np.uint8)) for n, hw in zip(result.names, result.photo_hw, strict=True)]
    for size in ("photo", "model"):
        export(result, folder, ["depth"], photos=photos, depth_size=size)
        assert ("interpolated" in contents(folder)["depth"]) == (size == "photo")
        assert "interpolated" not in FILES["depth"]
        assert ("depth", "depth/", FILES["depth"]) in page.files_beside(folder)


def test_report_viewer_and_files_have_the_same_points(tmp_path):
    """With masks and filters of the user's."""
    trimesh = pytest.importorskip("trimesh")
    folder = write_example(tmp_path / "out", truth=False, hw=(24, 32))
    result = Reconstruction.load(folder)
    masks = np.zeros(result.depth_z.shape, dtype=bool)
    masks[:, 4:, 3:30] = True
    write_files(folder, result, ["ply", "glb"], filters=FilterSettings(drop_share=0.1, flying=False), masks=masks)
    found = load_result(folder)
    (stage,) = (entry for entry in scene3d.scene_data(found)["stages"] if entry["key"] == "adapted")
    raw, n = base64.b64decode(stage["points"]), stage["count"]
    kept = np.frombuffer(raw[17 * n : 18 * n], np.uint8).astype(bool)
    level = scene3d.level_rotation(found.final.T_cam_world)
    page = np.frombuffer(raw[: 12 * n], "<f4").reshape(n, 3)[kept] @ level
    ply = trimesh.load(folder / "points.ply").vertices
    glb = trimesh.load(folder / "scene.glb", force="scene")
    (cloud,) = (g for g in glb.geometry.values() if isinstance(g, trimesh.PointCloud))
    assert 0 < len(ply) < masks.sum()
    assert np.array_equal(ply, cloud.vertices)
    # The viewer's points are `Stage.keep`, as tests/report/test_viewer.py checks.
    for points in (page, found.final.world_points()[found.final.keep]):
        assert np.allclose(in_order(points), in_order(ply), atol=1e-3)


def in_order(points: np.ndarray) -> np.ndarray:
    return np.sort(np.asarray(points, dtype=np.float64), axis=0)


def test_a_line_joins_cameras_only_where_they_follow_each_other(tmp_path):
    shown = {}
    for name, order in (("walk", np.arange(12)), ("photos", np.random.default_rng(1).permutation(12))):
        walk = ring(12, (12, 16))
        mixed = dataclasses.replace(walk, T_cam_world=walk.T_cam_world[order])
        mixed.save(tmp_path / name)
        shown[name] = load_result(tmp_path / name)
    assert shown["walk"].is_path and not shown["photos"].is_path
    lines = {name: figures.camera_plan(result).count("stroke-opacity: 0.6") for name, result in shown.items()}
    assert lines["walk"] == lines["photos"] + 1


def test_labels_of_cameras_do_not_overlap(tmp_path):
    close = ring(14, (12, 16))
    T = close.T_cam_world.copy()
    T[7:, :3, 3] = T[:7, :3, 3] + 0.02  # Seven pairs of cameras, nearly in one place each.
    T[7:, :3, :3] = T[:7, :3, :3]
    dataclasses.replace(close, T_cam_world=T).save(tmp_path)
    drawing = figures.camera_plan(load_result(tmp_path))
    texts = re.findall(r'<text style="font-size: 10px([^>]*)>(\d+)</text>', drawing)
    found = [
        (*re.search(r'(?:translate\(|x=")([-\d.]+)[ "]*(?:y=")?([-\d.]+)', style).groups(), text)
        for style, text in texts
        if "var(--frozen)" in style
    ]
    boxes = [(float(x), float(y), float(x) + 6 * len(text), float(y) + 8) for x, y, text in found]
    assert {text for _, _, text in found} >= {"1", "8"}
    for k, a in enumerate(boxes):
        for b in boxes[:k]:
            assert a[0] >= b[2] or b[0] >= a[2] or a[1] >= b[3] or b[1] >= a[3]


def test_everything_asked_for_is_there(example):
    for part in (
        "scene", "photos", "truth", "plan", "loss", "filters", "details", "canvas3d", "stage3d", "conf3d", "size3d",
    ):  # fmt: skip
        assert f'id="{part}"' in example
    for caption in ("depth, frozen", "depth, adapted", "change of depth", "depth error, frozen", "confidence, adapted"):
        assert example.count(f"<figcaption>{caption}</figcaption>") == 4, caption
    for text in ("contradicted by other views", "AUC@30°", "frozen prediction", "60 steps"):
        assert text in example


def test_the_svg_takes_the_colours_of_the_page(example):
    drawings = re.findall(r"<svg.*?</svg>", example, re.DOTALL)
    assert len(drawings) == 2
    for drawing in drawings:
        assert "currentColor" in drawing
        assert "var(--adapted)" in drawing
        assert not re.search(r"#0[0-9a-f]0[0-9a-f]0[0-9a-f]", drawing)
        assert "width=" not in drawing.split(">", 1)[0]


def test_the_page_says_the_unit(tmp_path):
    for scale, text in ((None, "up to scale"), (Scale(value=3.0, source=METRIC_MODEL), "metres (from a metric model)")):
        dataclasses.replace(room(2), scale=scale).save(tmp_path)
        assert f"<dt>lengths</dt><dd>{text}</dd>" in write_report(tmp_path).read_text(encoding="utf-8")


def test_a_frozen_run_without_cameras_has_a_page(tmp_path):
    plain = dataclasses.replace(room(2), T_cam_world=None, K=None, names=("a.jpg", "b.jpg"))
    plain.save(tmp_path)
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert "predicts no cameras" in text
    assert "canvas3d" not in text
    assert text.count("<figcaption>depth, frozen</figcaption>") == 2
    assert "change of depth" not in text
    assert "not stated in this folder" in text


def test_the_page_shows_the_points_that_the_command_kept(tmp_path):
    folder = write_example(tmp_path / "out", truth=False)
    shape = load_result(folder).final.keep.shape
    keep = np.zeros(shape, dtype=bool)
    keep[:, :5] = True
    report = FilterReport(pixels=keep.size, removed={"mask": int((~keep).sum()), "sky or ambiguous": 0}, tolerance=None)
    save_kept(folder, (keep, report))
    result = load_result(folder)
    assert np.array_equal(result.final.keep, keep)
    assert not np.array_equal(result.stages["frozen"].keep, keep)
    text = write_report(folder).read_text(encoding="utf-8")
    share = f"{100 * keep.mean():.1f} %"
    assert f"{share} of {keep.size:,}" in text
    assert re.search(rf"kept</th><td>{int(keep.sum()):,}</td><td>{share}", text)
    assert "Depth of all views together" not in text


def test_a_rejected_adapter_leaves_the_frozen_model_alone_on_the_page(tmp_path):
    folder = write_example(tmp_path / "out", truth=False)
    summary = files.read_json(folder / "reconstruction.json")
    files.write_json(folder / "reconstruction.json", {**summary, "adapter": None, "rejected_adapter": "It diverged."})
    result = load_result(folder)
    assert list(result.stages) == ["frozen"]
    assert result.final.key == "frozen"


def test_the_scene_holds_the_points_it_says(scene):
    result, data = scene
    for entry in data["stages"]:
        stage, n = result.stages[entry["key"]], entry["count"]
        raw = base64.b64decode(entry["points"])
        assert len(raw) == n * (12 + 3 + 1 + 1 + 1 + 1)
        xyz = np.frombuffer(raw[: 12 * n], "<f4").reshape(n, 3)
        kept = np.frombuffer(raw[17 * n : 18 * n], np.uint8).astype(bool)
        assert kept.sum() == min(int(stage.keep.sum()), scene3d.MAX_KEPT)
        level = scene3d.level_rotation(result.final.T_cam_world)
        expected = stage.world_points()[stage.keep] @ level.T
        assert np.allclose(np.sort(xyz[kept], axis=0), np.sort(expected, axis=0), atol=1e-4)
        rank = np.frombuffer(raw[15 * n : 16 * n], np.uint8)
        if stage.key != "truth":
            assert np.mean(rank[kept] < 50) == pytest.approx(0.5, abs=0.05)
        assert len(entry["cameras"]) == 4
    json.dumps(data)


@pytest.mark.parametrize("aspect", [0.6, 1.0, 2.2])
def test_the_first_view_of_the_viewer_holds_the_points_and_cameras(scene, aspect):
    result, _ = scene
    final, fov = result.final, np.deg2rad(50)
    level, points = scene3d.level_rotation(final.T_cam_world), scene3d.kept_points(final)
    eye, target = scene3d.first_view(final, level, points.mean(0), frusta=0.1, fov=fov, aspect=aspect)
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(level[1], back) / np.linalg.norm(np.cross(level[1], back))
    centres = -np.einsum("sij,si->sj", final.T_cam_world[:, :3, :3], final.T_cam_world[:, :3, 3])
    seen = (np.concatenate((points, centres)) - eye) @ np.stack((right, np.cross(back, right), -back)).T
    at = np.abs(seen[:, :2] / seen[:, 2:]) / np.tan(fov / 2) / (aspect, 1)
    assert (seen[:, 2] > 0).all() and (at < 1).all()
    assert at.max() > 0.9 * scene3d.FILLED


def test_the_level_frame_has_the_cameras_up_and_forward():
    T, _ = room(4).cameras()
    level = scene3d.level_rotation(T)
    assert np.allclose(level @ level.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(level) == pytest.approx(1)
    assert (level @ -T[:, 1, :3].mean(0))[1] > 0.5
    forward = level @ T[:, 2, :3].mean(0)
    assert forward[2] < 0
    assert abs(forward[0]) < 1e-6
    down = np.eye(4)[None].repeat(2, 0)
    down[1, :3, :3] = np.diag([-1.0, 1, -1])  # Two cameras back to back have no mean direction.
    assert np.isfinite(scene3d.level_rotation(down)).all()


def test_cameras_that_look_down_from_one_side_do_not_tilt_the_scene():
    turns = Rotation.from_euler("y", np.linspace(-45, 45, 7)[:, None], degrees=True)
    T = np.eye(4)[None].repeat(7, 0)
    T[:, :3, :3] = (Rotation.from_euler("x", 40, degrees=True) * turns).as_matrix()
    up = scene3d.level_rotation(T)[1]
    assert np.degrees(np.arccos(up @ (0, -1, 0))) < 10, "their mean up is 36 degrees off"


def test_colours_follow_one_scale_and_grey_is_invalid():
    values = np.array([[1.0, 10.0, 100.0, np.nan, -1.0]])
    colours = log_colours(values, (1, 100), "gray")
    assert colours[0, 0, 0] == 0
    assert colours[0, 2, 0] == 255
    assert abs(int(colours[0, 1, 0]) - 128) <= 2
    assert (colours[0, 3:] == INVALID_GREY).all()
    assert log_range(lambda: [np.zeros((2, 2))]) == (1.0, 2.0)
    low, high = log_range(lambda: [np.full((2, 2), 3.0)])
    assert low < 3 < high


def test_pictures_are_bounded(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (600, 1200, 3), dtype=np.uint8)
    assert figures.data_uri(noise).startswith("data:image/jpeg;base64,")
    assert len(figures.data_uri(noise)) < 80_000
    assert figures.data_uri(noise[:48, :64]).startswith("data:image/png;base64,")


def test_scores_of_another_shape_are_left_out():
    assert score_table({}) is None
    assert score_table({"frozen": {"4": {"auc30": 0.1}}}) is None
    assert score_table({"frozen": 3}) is None


def test_settings_are_flattened():
    assert list(flattened({"a": {"b": 1, "c": None}, "d": [1, 2], "e": list(range(20))})) == [
        ("a.b", "1"),
        ("a.c", "–"),
        ("d", "1, 2"),
        ("e", "20 entries"),
    ]
