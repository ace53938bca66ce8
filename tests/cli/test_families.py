"""Models of every build, with random weights, from photos to files: each command, chunks, known cameras."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cli.conftest import QUICK
from freegeo.cameras.known import KnownCamera, KnownCameras
from freegeo.cameras.plain import write
from freegeo.data.procedural import render, sample_rooms
from freegeo.export.reconstruction import Reconstruction
from freegeo.models.checkpoints import save_weights
from freegeo.models.spec import KeyRules
from tiny_models import tiny_mapanything, tiny_pi3, tiny_pi3x

pytestmark = pytest.mark.slow
BUILDS: dict[str, Callable] = {"tiny-pi3": tiny_pi3, "tiny-pi3x": tiny_pi3x, "tiny-mapanything": tiny_mapanything}
COUNT = 6
TESTS = Path(__file__).parents[1]
MILD = [*QUICK, "--lr", "1e-5"]
PLUGIN = """
from pathlib import Path

import tiny_models
from freegeo.models.spec import ModelEntry

for path in sorted(Path(__file__).parent.glob("*.safetensors")):
    build = getattr(tiny_models, path.stem.replace("-", "_"))
    globals()[build.__name__] = ModelEntry(
        name=path.stem, about="random weights", licence="none", parameters=0, build=build, packaged_weights=path
    )
"""


@pytest.fixture(scope="module")
def plugin(tmp_path_factory) -> Path:
    """A folder that holds an installed package with the models, for this process and for those it starts."""
    folder = tmp_path_factory.mktemp("plugin")
    for name, build in BUILDS.items():
        save_weights(build(), folder / f"{name}.safetensors", KeyRules(), {})
    (folder / "tiny_families.py").write_text(PLUGIN)
    about = folder / "tiny_families-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: tiny-families\nVersion: 1\n")
    points = "\n".join(f"{name} = tiny_families:{build.__name__}" for name, build in BUILDS.items())
    (about / "entry_points.txt").write_text(f"[freegeo.models]\n{points}\n")
    return folder


@pytest.fixture(autouse=True)
def installed(plugin, monkeypatch):
    monkeypatch.syspath_prepend(plugin)
    paths = [str(plugin), str(TESTS), str(TESTS.parent / "src"), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))


@pytest.fixture(scope="module")
def views():
    return render(sample_rooms([20_000_003], domain="test-id", frames=COUNT), 48, 64)


@pytest.fixture(scope="module")
def photos(views, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    for k, image in enumerate(views.images[0]):
        Image.fromarray((image.permute(1, 2, 0) * 255).round().byte().numpy()).save(folder / f"{k}.png")
    return folder


@pytest.fixture(scope="module")
def cameras(views, tmp_path_factory) -> Path:
    """The true cameras of all photos but the first: poses of four, intrinsics of five."""
    found = []
    for k, (T, K) in enumerate(zip(views.T_cam_world[0].double().numpy(), views.K[0].double().numpy(), strict=True)):
        u, _, vh = np.linalg.svd(T[:3, :3])
        T[:3, :3] = u @ vh
        K[:2, 2] += 0.5
        found.append(KnownCamera(T_cam_world=T if k > 1 else None, K=K if k > 0 else None, size_hw=(48, 64)))
    path = tmp_path_factory.mktemp("known") / "cameras.json"
    write(KnownCameras(names=tuple(f"{k}.png" for k in range(COUNT)), cameras=tuple(found), source="x"), path)
    return path


def summary(folder: Path) -> dict:
    return json.loads((folder / "reconstruction.json").read_text())


@pytest.mark.parametrize("name", BUILDS)
def test_run_with_the_guard_and_all_formats(freegeo, photos, tmp_path, name):
    out = tmp_path / "out"
    outcome = freegeo(
        "run", photos, "-o", out, "--model", name, *QUICK[:4], "--lr", "1e-5", "--drop-share", "0", "--formats", "all"
    )
    assert outcome.code in (0, 3), outcome.err
    found, about = Reconstruction.load(out), summary(out)
    assert len(found.names) == COUNT and np.isfinite(found.depth_z).all()
    assert about["verdict"] is not None and about["reference_view"] == BUILDS[name]().spec.reference
    assert (found.scale is not None) == BUILDS[name]().spec.metric
    assert (out / "report.html").is_file() and (out / "transforms.json").is_file()


@pytest.mark.parametrize("name", BUILDS)
def test_an_adapter_for_a_scene_is_used_later(freegeo, photos, tmp_path, name):
    outcome = freegeo("adapt", photos, "-o", tmp_path / "adapter", "--model", name, *MILD)
    assert outcome.code == 0, outcome.err
    outcome = freegeo(
        "reconstruct", photos, "-o", tmp_path / "out", "--adapter", tmp_path / "adapter", "--formats", "npz"
    )
    assert outcome.code == 0, outcome.err
    assert summary(tmp_path / "out")["model"] == name
    merged = tmp_path / "merged.safetensors"
    assert freegeo("adapter", "merge", tmp_path / "adapter", "-o", merged).code == 0
    outcome = freegeo(
        "reconstruct", photos, "-o", tmp_path / "again", "--model", name, "--checkpoint", merged, "--formats", "npz"
    )
    assert outcome.code == 0, outcome.err
    one, two = (Reconstruction.load(tmp_path / folder) for folder in ("out", "again"))
    np.testing.assert_allclose(one.depth_z, two.depth_z, rtol=1e-3)


@pytest.mark.parametrize("name", BUILDS)
def test_chunks_and_many_scenes(freegeo, photos, tmp_path, name):
    model = ["--model", name, "--formats", "npz"]
    outcome = freegeo("reconstruct", photos, "-o", tmp_path / "chunks", *model, "--chunk", "4", "--overlap", "2")
    assert outcome.code in (0, 3), outcome.err
    assert "chunks" in outcome.err
    outcome = freegeo("batch", photos, photos / "0.png", "-o", tmp_path / "many", *model, "--no-adapt")
    assert outcome.code == 0, outcome.err
    assert (tmp_path / "many" / "index.html").is_file()


@pytest.mark.parametrize("name", BUILDS)
def test_cameras_that_are_known_of_some_photos(freegeo, photos, cameras, tmp_path, name):
    out = tmp_path / "out"
    outcome = freegeo(
        "run", photos, "-o", out, "--model", name, *MILD, "--cameras", cameras, "--trust-cameras", "--formats", "npz"
    )
    assert outcome.code == 0, outcome.err
    told = BUILDS[name]().spec.takes == "parts"
    assert ("is told the cameras of" in outcome.err) == told
    about = summary(out)
    assert about["known_cameras"]["poses"] == COUNT - 2 and about["known_cameras"]["intrinsics"] == COUNT - 1
    assert np.isfinite(Reconstruction.load(out).T_cam_world).all()


@pytest.mark.parametrize("name", BUILDS)
def test_predictions_for_a_table_of_the_paper(freegeo, tmp_path, name):
    few = ["--datasets", "procedural-test-id", "--scenes", "1", "--views", "4", "--seeds", "43", "--frames", "da3"]
    place = ["--data", tmp_path / "data", "-o", tmp_path / "out"]
    outcome = freegeo("bench", "predict", "main", *few, *place, "--model", name, *MILD[:4])
    assert outcome.code == 0, outcome.err
