"""Pixels outside the photo, the padding of an image, reach no file and no view."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import freegeo
from exact_rooms import PHOTO_SCALE, cloud_of, room
from freegeo.data.photos import MemoryPhoto
from freegeo.export.formats import export, filter_reconstruction
from freegeo.export.mesh import fuse, voxel_size
from freegeo.export.pixels import corner_pixels, masks_for_model
from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.filtering import filter_pixels
from freegeo.fusion.normals import point_normals
from freegeo.fusion.settings import FilterSettings
from freegeo.fusion.tracks import build_tracks
from freegeo.geometry.camera import project
from freegeo.geometry.se3 import transform_points
from freegeo.report.result import load_result
from tiny_models import tiny_vggt

EVERYTHING = FilterSettings(drop_share=0, flying=False, multi_view=False)
WHOLE = (0, 0, 48, 64)
BOXES = (WHOLE, (12, 0, 36, 64), (0, 20, 48, 44), (3, 5, 47, 60))
"""Of each view the rows and columns (top, left, bottom, right) that show the photo."""


def padded(boxes=BOXES) -> tuple[Reconstruction, np.ndarray]:
    """Return a room with white padding of which depth and confidence look as good as the rest, and what is photo."""
    scene = room(views=len(boxes))
    inside = np.zeros(scene.depth_z.shape, bool)
    for view, (top, left, bottom, right) in enumerate(boxes):
        inside[view, top:bottom, left:right] = True
    scene = replace(
        scene,
        images=np.where(inside[..., None], scene.images.clip(0, 250), 255).astype(np.uint8),
        photo_hw=np.array([[PHOTO_SCALE * (b - t), PHOTO_SCALE * (r - l)] for t, l, b, r in boxes]),
        offset_xy=np.array([[left, top] for top, left, _, _ in boxes], dtype=np.float64),
    )
    return scene, inside


def test_the_mask_follows_from_scale_and_offset():
    scene, inside = padded()
    assert (scene.inside() == inside).all()
    assert room().inside().all() and room(crop=7).inside().all(), "a cut photo has no padding"


def test_normals_do_not_follow_what_is_in_the_padding():
    scene, inside = padded()
    cloud = cloud_of(scene, keep=inside, drop_share=0.0, drop_flying=False)
    # Close enough to the photo's edge to be taken for its surface.
    bent = replace(scene, depth_z=np.where(inside, scene.depth_z, 1.01 * scene.depth_z))
    blank = replace(scene, depth_z=np.where(inside, scene.depth_z, np.nan))
    of_bent, of_blank = (point_normals(cloud, s.depth_z, *s.cameras(), s.inside()) for s in (bent, blank))
    np.testing.assert_array_equal(of_bent, of_blank)


def test_filters_count_padding_apart_and_keep_none_of_it():
    scene, inside = padded()
    keep, report = filter_reconstruction(scene)
    assert not keep[~inside].any()
    assert next(iter(report.removed)) == "outside the photo"
    assert report.removed["outside the photo"] == (~inside).sum()
    assert report.removed["invalid depth"] == 0
    everything, report = filter_reconstruction(scene, settings=EVERYTHING)
    assert (everything == inside).all()
    assert "outside the photo" in report.summary()
    assert "outside the photo" not in filter_reconstruction(room())[1].removed


def test_what_padding_holds_does_not_matter_to_the_filters():
    scene, inside = padded()
    spoiled = replace(
        scene,
        depth_z=np.where(inside, scene.depth_z, 0.3).astype(np.float32),
        conf=np.where(inside, scene.conf, 99).astype(np.float32),
    )
    (one, report), (two, other) = filter_reconstruction(scene), filter_reconstruction(spoiled)
    assert (one == two).all()
    assert report == other


def test_a_view_is_not_asked_about_what_falls_into_its_padding():
    depth = np.full((2, 16, 20), 2.0, np.float32)
    T = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    K = np.tile(np.array([[20, 0, 10], [0, 20, 8], [0, 0, 1]], np.float32), (2, 1, 1))
    right = np.ones(depth.shape, bool)
    right[1, :, :10] = False
    settings = FilterSettings(drop_share=0, flying=False, min_agreeing=1)
    keep, _ = filter_pixels(depth, np.ones_like(depth), T, K, inside=right, settings=settings)
    assert (keep == right).all(), "what view 1 does not show has nobody to agree, and stays"


def test_no_format_holds_a_point_or_a_colour_of_padding(tmp_path):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    scene, inside = padded()
    export(scene, tmp_path, ["all"], filtered=filter_reconstruction(scene, settings=EVERYTHING))
    points = trimesh.load(tmp_path / "points.ply")
    assert len(points.vertices) == inside.sum()
    clouds = (points.colors, trimesh.load(tmp_path / "scene.glb").geometry["points"].colors)
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False).visual.vertex_colors
    for colours in (*clouds, mesh):
        assert (np.asarray(colours)[:, :3] <= 250).all(), "no white of the padding, and none mixed in"
    for view, name in enumerate(scene.names):
        depth = np.asarray(Image.open(tmp_path / "depth" / name.replace(".JPG", ".png")))
        assert ((depth > 0) == inside[view]).all()


def test_depth_files_without_cameras_leave_padding_out_too(tmp_path):
    scene, inside = padded()
    replace(scene, T_cam_world=None, K=None).export(tmp_path, ["depth"])
    depth = [np.asarray(Image.open(path)) for path in sorted((tmp_path / "depth").glob("*.png"))]
    assert ((np.stack(depth) > 0) == inside).all()


def test_the_surface_ends_where_the_photo_does():
    scene, _ = padded(((12, 16, 36, 48),))
    keep, _ = filter_reconstruction(scene, settings=EVERYTHING)
    voxel = voxel_size(scene, keep)
    T, K = (torch.from_numpy(a[0]) for a in scene.cameras())
    vertices = transform_points(T, torch.from_numpy(fuse(scene, keep, voxel=voxel).vertices).float())
    column, row = project(vertices, K).unbind(-1)
    assert len(vertices) > 100
    margin = 2 * voxel * float(K[0, 0]) / float(vertices[:, 2].min())
    assert column.min() > 16 - margin and column.max() < 47 + margin
    assert row.min() > 12 - margin and row.max() < 35 + margin


def test_every_observation_lies_in_its_photo():
    scene, _ = padded()
    keep, report = filter_reconstruction(scene, settings=FilterSettings(drop_share=0))
    tracks = build_tracks(scene.depth_z, *scene.cameras(), scene.images, keep, tolerance=report.tolerance)
    places, size = corner_pixels(scene, tracks.view, tracks.pixel), scene.photo_hw[tracks.view][:, ::-1]
    assert len(np.unique(tracks.view)) == len(scene)
    assert ((places >= 0) & (places <= size)).all()


def test_masks_are_false_in_padding_whatever_they_say():
    scene, inside = padded()
    of_photos = [np.ones(tuple(hw), np.uint8) for hw in scene.photo_hw]
    assert (masks_for_model(scene, of_photos) == inside).all()
    assert (masks_for_model(scene, list(np.ones(inside.shape, np.uint8))) == inside).all()


def test_the_report_keeps_no_padding(tmp_path):
    scene, inside = padded()
    scene.save(tmp_path)
    final = load_result(tmp_path).final
    assert final.keep.any() and not final.keep[~inside].any()
    replace(scene, T_cam_world=None, K=None).save(tmp_path / "flat")
    assert (load_result(tmp_path / "flat").final.keep == inside).all()


@pytest.mark.parametrize("mixed", ["crop", "pad", "upstream"])
@pytest.mark.parametrize("sizes_wh", [((64, 48), (48, 64)), ((48, 64), (48, 48)), ((128, 48), (64, 48))])
def test_a_model_that_pads_makes_no_point_of_it(mixed, sizes_wh):
    usual, odd = sizes_wh
    pixels = [np.random.default_rng(n).integers(0, 200, (*size[::-1], 3), dtype=np.uint8) for n, size in
              enumerate([usual, usual, odd, usual])]  # fmt: skip
    found = [MemoryPhoto(f"{n}.png", p) for n, p in enumerate(pixels)]
    scene = freegeo.reconstruct(tiny_vggt(), found, mixed=mixed, device="cpu")
    white = (scene.images == 255).all(-1)
    assert (scene.inside() == ~white).all()
    assert white.any() == (mixed != "crop")
    keep, _ = filter_reconstruction(scene, settings=EVERYTHING)
    assert (keep == scene.inside()).all()
