"""The recording for rerun, read back with its own reader."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from exact_rooms import room
from freegeo.errors import UserError
from freegeo.export.formats import check_formats, export

pytestmark = pytest.mark.slow
"""Loading rerun takes seconds."""


def content(path):
    """Rows by entity: (number of the view or None, column -> value)."""
    reader = pytest.importorskip("rerun.chunk", reason="needs the extra rerun")
    found = {}
    for chunk in reader.RrdReader(path).stream():
        for row in chunk.to_record_batch().to_pylist():
            values = {name: value for name, value in row.items() if value is not None}
            found.setdefault(chunk.entity_path, []).append((values.get("view"), values))
    return {entity: sorted(rows, key=lambda row: row[0] or 0) for entity, rows in found.items()}


def test_a_recording_has_points_cameras_images_and_depth(tmp_path):
    scene = room()
    depth = scene.depth_z.copy()
    depth[1, 3, 4], depth[2] = np.nan, 0
    scene = replace(scene, depth_z=depth)
    masks = np.ones(depth.shape, bool)
    masks[0, :10] = False
    assert export(scene, tmp_path, ["rerun"], masks=masks, max_points=500).files == [tmp_path / "scene.rrd"]
    found = content(tmp_path / "scene.rrd")
    ((_, points),) = found["/world/points"]
    assert len(points["Points3D:positions"]) == len(points["Points3D:colors"]) == 500
    assert points["lengths"] == ["up to scale"]
    for view, (number, camera) in enumerate(found["/world/camera"]):
        assert number == view
        assert camera["photo"] == [scene.names[view]]
        K = np.reshape(camera["Pinhole:image_from_camera"][0], (3, 3)).T
        np.testing.assert_allclose(K, scene.K[view] + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], rtol=1e-6)
        R = np.reshape(camera["Transform3D:mat3x3"][0], (3, 3)).T
        pose = np.linalg.inv(scene.T_cam_world[view])
        np.testing.assert_allclose(R, pose[:3, :3], atol=1e-5)
        np.testing.assert_allclose(camera["Transform3D:translation"][0], pose[:3, 3], atol=1e-5)
    for view, (number, values) in enumerate(found["/world/camera/depth"]):
        assert number == view
        stored = np.frombuffer(bytes(values["DepthImage:buffer"][0]), np.uint16).reshape(depth.shape[1:])
        valid = np.isfinite(depth[view]) & (depth[view] > 0) & masks[view]
        np.testing.assert_array_equal(stored > 0, valid)
        np.testing.assert_allclose(stored[valid] / values["DepthImage:meter"][0], depth[view][valid], rtol=1e-3)
    for view, (_, values) in enumerate(found["/world/camera/image"]):
        with Image.open(io.BytesIO(bytes(values["EncodedImage:blob"][0]))) as image:
            assert np.abs(np.asarray(image).astype(int) - scene.images[view]).mean() < 6


def test_without_rerun_it_is_refused_with_the_extra_and_left_out_of_all(monkeypatch, caplog):
    monkeypatch.setattr("freegeo.export.rerun.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'freegeo\[rerun\]'"):
        check_formats(["rerun"], ["a.jpg", "b.jpg"])
    assert "rerun" not in check_formats(["all"], ["a.jpg", "b.jpg"])
    assert "'all' leaves out rerun" in caplog.text
