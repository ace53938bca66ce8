import numpy as np
import pytest
import torch
from PIL import Image

from freegeo.errors import DamagedError, FreeGeoError, UserError
from freegeo.export.mesh import load_mesh
from freegeo.fusion.marching import extract_surface
from freegeo.fusion.mesh import Mesh, empty_mesh_substitute, read_mesh, sample_surface
from freegeo.fusion.tsdf import TsdfVolume

K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
EYE = torch.eye(4)


def plane_volume(**options) -> TsdfVolume:
    volume = TsdfVolume(voxel=0.05, truncation=0.2, **options)
    volume.integrate(torch.full((48, 64), 2.03), K, EYE)
    return volume


def test_a_plane_comes_back_where_it_was():
    mesh = plane_volume().extract_mesh()
    assert not mesh.is_empty
    np.testing.assert_allclose(mesh.vertices[:, 2], 2.03, atol=2e-3)
    # The area that all pixels see, less a rim of about one voxel.
    assert mesh.area == pytest.approx((64 / 60 * 2.03) * (48 / 60 * 2.03), rel=0.08)


def test_normals_point_to_the_camera():
    mesh = plane_volume().extract_mesh()
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] < 0).all()


def test_fusing_twice_changes_weights_but_not_the_surface():
    once, twice = plane_volume(), plane_volume()
    twice.integrate(torch.full((48, 64), 2.03), K, EYE)
    np.testing.assert_allclose(once.extract_mesh().vertices, twice.extract_mesh().vertices, atol=1e-6)
    assert twice.blocks()[2].max() == 2 * once.blocks()[2].max() == 2


def test_two_depths_average():
    volume = TsdfVolume(voxel=0.05, truncation=0.2)
    for depth in (2.00, 2.06):
        volume.integrate(torch.full((48, 64), depth), K, EYE)
    middle = np.median(volume.extract_mesh().vertices[:, 2])
    assert middle == pytest.approx(2.03, abs=2e-3)


def test_holes_and_far_depths_leave_no_trace():
    volume = TsdfVolume(voxel=0.05, truncation=0.2)
    depth = torch.tensor([0.0, -1.0, float("nan"), float("inf"), 5.0, 7.0]).repeat(48, 11)[:, :64]
    volume.integrate(depth, K, EYE, depth_limit=5.0)
    assert volume.block_count == 0
    assert volume.extract_mesh().is_empty


def test_a_depth_map_is_not_modified():
    depth = torch.full((48, 64), 2.0)
    depth[0, 0] = float("nan")
    before = depth.clone()
    TsdfVolume(voxel=0.05, truncation=0.2).integrate(depth, K, EYE)
    assert torch.equal(depth.nan_to_num(7), before.nan_to_num(7))


def test_bad_input_is_refused():
    volume = TsdfVolume(voxel=0.05, truncation=0.2)
    with pytest.raises(UserError, match="finite"):
        volume.integrate(torch.ones(4, 4), K, EYE * float("nan"))
    with pytest.raises(UserError):
        volume.integrate(torch.ones(1, 4, 4), K, EYE)
    with pytest.raises(UserError):
        TsdfVolume(voxel=0, truncation=0.2)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_cuda_gives_the_same_surface():
    here, there = plane_volume().extract_mesh(), plane_volume(device="cuda").extract_mesh()
    assert len(here.triangles) == len(there.triangles)
    np.testing.assert_allclose(here.vertices, there.vertices, atol=1e-4)


def _sphere(edge: int, blocks: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A sphere of radius 9 voxels in the middle of blocks^3 blocks of edge^3 voxels."""
    index = torch.cartesian_prod(*[torch.arange(blocks)] * 3)
    inside = torch.stack(torch.meshgrid(*[torch.arange(edge) + 0.5] * 3, indexing="ij"), dim=-1)
    points = index[:, None, None, None] * edge + inside
    return index, (points - edge * blocks / 2).norm(dim=-1) - 9.0


@pytest.mark.parametrize(("edge", "blocks"), [(24, 1), (12, 2), (8, 3)])
def test_blocks_join_into_one_closed_surface(edge, blocks):
    index, field = _sphere(edge, blocks)
    vertices, triangles = extract_surface(index, field, torch.ones_like(field), voxel=1.0)
    mesh = Mesh(vertices=vertices.numpy(), triangles=triangles.numpy())
    edges = np.sort(np.concatenate([mesh.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    counts = np.unique(edges, axis=0, return_counts=True)[1]
    assert (counts == 2).all()  # watertight
    assert len(vertices) - len(counts) + len(triangles) == 2  # and of the topology of a sphere
    assert mesh.area == pytest.approx(4 * np.pi * 81, rel=0.01)
    whole = extract_surface(*_first(_sphere(24, 1)), voxel=1.0)
    assert (len(vertices), len(triangles)) == (len(whole[0]), len(whole[1]))


def _first(pair):
    return pair[0], pair[1], torch.ones_like(pair[1])


def test_cubes_with_an_unseen_corner_are_left_out():
    index, field = _sphere(24, 1)
    weight = torch.ones_like(field)
    weight[:, :, :, :12] = 0
    vertices, _ = extract_surface(index, field, weight, voxel=1.0)
    assert vertices[:, 2].min() >= 12.5


def test_samples_lie_on_the_surface_in_proportion_to_area():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [3, 0, 5], [0, 1, 5]])
    mesh = Mesh(vertices=vertices, triangles=np.array([[0, 1, 2], [3, 4, 5]]))
    points = sample_surface(mesh, 20_000, seed=1)
    high = points[:, 2] > 2.5
    np.testing.assert_allclose(points[:, 2], np.where(high, 5.0, 0.0), atol=1e-12)
    assert high.mean() == pytest.approx(0.75, abs=0.01)
    assert np.array_equal(points, sample_surface(mesh, 20_000, seed=1))
    assert not np.array_equal(points, sample_surface(mesh, 20_000, seed=2))


def test_a_mesh_without_surface_cannot_be_sampled():
    empty = Mesh(vertices=np.zeros((0, 3)), triangles=np.zeros((0, 3), np.int64))
    with pytest.raises(UserError):
        sample_surface(empty, 10, seed=0)
    assert np.abs(empty_mesh_substitute(100)).max() <= 1
    with pytest.raises(UserError):
        read_mesh("no/such.ply")


MATERIALS = {
    "m.ply": "ply\nformat ascii 1.0\ncomment TextureFile picture.eps\nelement vertex 3\nproperty float x\n"
    "property float y\nproperty float z\nproperty float s\nproperty float t\nelement face 1\n"
    "property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n",
    "m.obj": "mtllib m.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n",
}


@pytest.mark.parametrize("name", MATERIALS)
def test_a_mesh_opens_no_picture_that_it_names(tmp_path, monkeypatch, name, capfd):
    Image.new("RGB", (8, 8)).save(tmp_path / "picture.eps")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd picture.eps\n")
    (tmp_path / name).write_text(MATERIALS[name])
    monkeypatch.setattr(Image, "open", lambda *arguments, **options: pytest.fail("a picture was opened"))
    for read in (read_mesh, load_mesh):
        assert len(read(tmp_path / name).vertices) == 3
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", ["scene.glb", "scene.gltf", "scene.zip", "scene", "scene.xyz"])
def test_other_kinds_of_meshes_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(UserError, match="a mesh is read from ply, obj, stl, off"):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    "error", [UnboundLocalError("x"), KeyError("x"), AttributeError("x"), IndexError("x")], ids=repr
)
def test_what_the_reader_of_meshes_raises_for_a_damaged_file_is_one_sentence(tmp_path, monkeypatch, error):
    def fail(*arguments, **options):
        raise error

    (tmp_path / "m.ply").write_text(MATERIALS["m.ply"])
    monkeypatch.setattr("trimesh.load", fail)
    with pytest.raises(
        DamagedError, match=rf"m\.ply: damaged file \({type(error).__name__}: .*Copy or export it again"
    ):
        read_mesh(tmp_path / "m.ply")


def test_memory_that_is_exhausted_by_a_mesh_is_no_damage(tmp_path, monkeypatch):
    def fail(*arguments, **options):
        raise MemoryError

    (tmp_path / "m.ply").write_text(MATERIALS["m.ply"])
    monkeypatch.setattr("trimesh.load", fail)
    with pytest.raises(MemoryError):
        read_mesh(tmp_path / "m.ply")


@pytest.mark.parametrize("name", MATERIALS)
def test_a_damaged_mesh_is_named(tmp_path, name):
    (tmp_path / name).write_text(MATERIALS[name].replace("3 0 1 2", "3 0 1").replace("f 1/1 2/2 3/3", "f 1/1 2/2 9/x"))
    with pytest.raises(FreeGeoError, match=name):
        read_mesh(tmp_path / name)
