"""Fusion, sampling and distances compared with Open3D, which the published evaluation computes with.

Run with `make test-oracle`; without the extra `oracle` these tests fail at the import.
"""

import numpy as np
import pytest

from freegeo.data.procedural import render, sample_rooms
from freegeo.fusion.mesh import Mesh, sample_surface
from freegeo.fusion.tsdf import TsdfVolume
from freegeo.metrics.cloud import nearest_distances, score_clouds, voxel_average

pytestmark = pytest.mark.oracle

HW = (96, 128)
DEPTH_LIMIT_M = 4.0
VOXELS_M = (0.1, 0.05, 0.02)


@pytest.fixture(scope="module")
def open3d():
    import open3d

    return open3d


@pytest.fixture(scope="module")
def views():
    """Eight views of a generated room."""
    return render(sample_rooms([20_000_003], domain="test-id", frames=8), *HW)


def our_mesh(views, voxel: float) -> Mesh:
    volume = TsdfVolume(voxel=voxel, truncation=4 * voxel)
    for depth_z, K, T in zip(views.depth_z[0], views.K[0], views.T_cam_world[0], strict=True):
        volume.integrate(depth_z, K, T, depth_limit=DEPTH_LIMIT_M)
    return volume.extract_mesh()


def their_mesh(open3d, views, voxel: float):
    integration = open3d.pipelines.integration
    volume = integration.ScalableTSDFVolume(
        voxel_length=voxel, sdf_trunc=4 * voxel, color_type=integration.TSDFVolumeColorType.NoColor
    )
    no_colour = open3d.geometry.Image(np.zeros((*HW, 3), np.uint8))
    for depth_z, K, T in zip(views.depth_z[0], views.K[0].double(), views.T_cam_world[0].double(), strict=True):
        frame = open3d.geometry.RGBDImage.create_from_color_and_depth(
            no_colour, open3d.geometry.Image(depth_z.numpy()), depth_scale=1.0, depth_trunc=DEPTH_LIMIT_M
        )
        height, width = HW
        camera = open3d.camera.PinholeCameraIntrinsic(width, height, K.numpy())
        volume.integrate(frame, camera, T.numpy())
    return volume.extract_triangle_mesh()


def as_mesh(theirs) -> Mesh:
    return Mesh(vertices=np.asarray(theirs.vertices), triangles=np.asarray(theirs.triangles).astype(np.int64))


def as_cloud(open3d, points: np.ndarray):
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))


@pytest.fixture(scope="module", params=VOXELS_M)
def pair(request, open3d, views):
    """Both meshes of one voxel edge, and that edge."""
    return our_mesh(views, request.param), their_mesh(open3d, views, request.param), request.param


def test_the_surface_is_the_same(pair):
    ours, theirs, voxel = pair[0], as_mesh(pair[1]), pair[2]
    # Both compute in float32, in another order. That moves a vertex by some millionths of a voxel; where it changes
    # the sign of a distance of almost zero, or the pixel that a voxel falls into, the cubes around are cut otherwise.
    assert len(ours.vertices) == pytest.approx(len(theirs.vertices), rel=2e-3)
    assert len(ours.triangles) == pytest.approx(len(theirs.triangles), rel=2e-3)
    for one, other in ((ours, theirs), (theirs, ours)):
        distance = nearest_distances(one.vertices, other.vertices) / voxel
        assert np.median(distance) < 1e-5
        assert (distance > 1e-3).mean() < 1e-3
    assert ours.area == pytest.approx(pair[1].get_surface_area(), rel=1e-5)


def test_samples_of_one_mesh_are_equal_to_the_last_bit(open3d, pair):
    open3d.utility.random.seed(5)
    theirs = np.asarray(pair[1].sample_points_uniformly(20_000).points)
    assert np.array_equal(sample_surface(as_mesh(pair[1]), 20_000, seed=5), theirs)


def test_cells_have_the_same_means(open3d, pair):
    points = pair[0].vertices
    theirs = np.asarray(
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)).voxel_down_sample(0.15).points
    )
    ours = voxel_average(points, 0.15)
    assert len(ours) == len(theirs)
    assert nearest_distances(ours, theirs).max() < 1e-12
    assert nearest_distances(theirs, ours).max() < 1e-12


def test_distances_and_score_are_the_same(open3d, pair):
    rng = np.random.default_rng(0)
    ours, truth = pair[0].vertices + 0.05 * rng.normal(size=(len(pair[0].vertices), 3)), pair[0].vertices
    their_ours, their_truth = as_cloud(open3d, ours), as_cloud(open3d, truth)
    there = np.asarray(their_ours.compute_point_cloud_distance(their_truth))
    back = np.asarray(their_truth.compute_point_cloud_distance(their_ours))
    np.testing.assert_allclose(nearest_distances(ours, truth), there, rtol=0, atol=1e-12)
    score = score_clouds(ours, truth, threshold=0.05)
    assert (score.acc, score.comp) == pytest.approx((there.mean(), back.mean()), abs=1e-12)
    assert (score.precision, score.recall) == ((there < 0.05).mean(), (back < 0.05).mean())
