import numpy as np
import pytest
from PIL import Image

from bench_tools import DATASET, ROOMS, store_truth, task
from freegeo.benchmark.paper import figures
from freegeo.benchmark.paper.figures import CloudPanel, cloud_figure, curve_figure, depth_panel, draw_all, save_figure
from freegeo.benchmark.results import rows_of
from freegeo.benchmark.score import evaluate_all
from freegeo.data.datasets.registry import load_scene


@pytest.mark.slow
def test_a_benchmark_folder_gets_its_figures_in_both_formats(tmp_path, small_rooms, monkeypatch):
    monkeypatch.setattr(figures, "CLOUD_POINTS", 500)
    data, out = tmp_path / "data", tmp_path / "out"
    tasks = [task(), task("adapted"), task(views=8), task(rule="experiment"), task("8to4", rule="experiment")]
    for one in tasks:
        store_truth(data, out, one)
    evaluate_all(data, out)
    files = draw_all(data, out)
    names = {path.stem for path in files}
    pairs = {f"{kind}-{pair}-{DATASET}" for kind in ("cloud", "depth") for pair in ("before-after", "8to4")}
    assert names == {f"views-{DATASET}", *pairs}
    for stem in names:
        assert np.asarray(Image.open(out / "figures" / f"{stem}.png")).std() > 5, "an empty picture"
        assert (out / "figures" / f"{stem}.pdf").read_bytes().startswith(b"%PDF")

    scene = load_scene(data, DATASET, ROOMS[0])
    panel = depth_panel("frozen", scene, tasks[0], out)
    assert panel.depth_z.shape == panel.relative_error.shape
    assert np.nanmax(panel.relative_error) < 1e-5


def test_points_beyond_the_threshold_are_red(tmp_path):
    rng = np.random.default_rng(0)
    truth = rng.uniform(-1, 1, size=(2000, 3)) * (3, 2, 0.1)
    distance = np.where(truth[:, 0] > 1.5, 1.0, 0.0)
    figure = cloud_figure([CloudPanel(title="a", points=truth, distance=distance)], truth, 0.15, "clouds")
    assert f"{(distance > 0).mean():.0%} beyond 0.15 m" in figure.axes[0].get_title()
    pixels = np.asarray(Image.open(save_figure(figure, tmp_path / "cloud")[0]).convert("RGB")).astype(int)
    red = (pixels[..., 0] > 180) & (pixels[..., 1] < 90)
    rows, columns = np.nonzero(red[100:-100])
    assert len(rows) > 100
    assert np.ptp(columns) < 0.4 * pixels.shape[1], "only the far quarter is red"


def test_a_curve_needs_two_numbers_of_views():
    rows = rows_of(task(), "m", 4, {"auc30": 0.5, "fscore": 0.2})
    assert curve_figure(rows, "rooms") is None
    assert curve_figure([*rows, *rows_of(task(views=8), "m", 8, {"auc30": 0.6, "fscore": 0.3})], "rooms") is not None
