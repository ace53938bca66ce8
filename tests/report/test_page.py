import base64
import dataclasses
import html
import json
import re

import numpy as np
import pytest

from exact_rooms import room
from example_results import HOSTILE_NAME, write_example
from freegeo import files
from freegeo.export.kept import save_kept
from freegeo.export.reconstruction import METRIC_MODEL, Scale
from freegeo.fusion.filtering import FilterReport
from freegeo.report import figures, scene3d
from freegeo.report.page import flattened, score_table, write_report
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
    assert not re.search(r"(src|href)\s*=\s*[\"'](?!data:|#)", without_namespaces)
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
    files.write_json(folder / "reconstruction.json", {**summary, "warnings": ["Half of <b>a.png</b> is cut off."]})
    page = write_report(folder).read_text(encoding="utf-8")
    assert 'class="warnings"' not in plain
    assert page.index("Half of &lt;b&gt;a.png&lt;/b&gt; is cut off.") < page.index("<main>")


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
    report = FilterReport(pixels=keep.size, removed={"mask": int((~keep).sum()), "sky": 0}, tolerance=None)
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


def test_colours_follow_one_scale_and_grey_is_invalid():
    values = np.array([[1.0, 10.0, 100.0, np.nan, -1.0]])
    colours = figures.log_colours(values, (1, 100), "gray")
    assert colours[0, 0, 0] == 0
    assert colours[0, 2, 0] == 255
    assert abs(int(colours[0, 1, 0]) - 128) <= 2
    assert (colours[0, 3:] == figures.INVALID_GREY).all()
    assert figures.log_range([np.zeros((2, 2))]) == (1.0, 2.0)
    low, high = figures.log_range([np.full((2, 2), 3.0)])
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
