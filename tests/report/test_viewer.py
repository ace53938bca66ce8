import dataclasses
import io
import itertools
import socket

import numpy as np
import pytest
import torch

from exact_rooms import room
from example_results import write_example
from example_sequences import write_sequence
from freegeo.errors import FreeGeoError, UserError
from freegeo.geometry.rotation import quat_wxyz_to_xyzw, quat_xyzw_to_matrix

pytest.importorskip("viser")
from freegeo.cli import view as command
from freegeo.report import viewer
from freegeo.report.origin import is_own_page, own_pages_only


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    return write_example(tmp_path_factory.mktemp("viewer") / "out", hw=(24, 32))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def opened(example):
    shown = viewer.open_viewer([example], port=free_port())
    yield shown
    shown.close()


def visible(handles) -> int:
    return sum(handle.visible for handle in handles)


def test_the_controls_show_and_hide(opened):
    names = {layer.stage.key: layer.name for layer in opened.layers}
    assert list(names) == ["frozen", "adapted", "truth"]
    assert opened.shown.value == "adapted"
    assert visible(opened.bands[names["adapted"]]) == viewer.BANDS
    assert visible(opened.bands[names["frozen"]]) == 0
    opened.hidden.value = 50
    assert visible(opened.bands[names["adapted"]]) == viewer.BANDS // 2
    opened.shown.value = "frozen"
    assert visible(opened.bands[names["frozen"]]) == viewer.BANDS // 2
    assert visible(opened.frusta[names["frozen"]]) == 4
    assert visible(opened.frusta[names["adapted"]]) == 0
    opened.swap.value = True
    assert opened.shown.value == "adapted"
    before = opened.bands[names["adapted"]][-1].colors.copy()
    opened.mode.value = "error"
    assert not np.array_equal(before, opened.bands[names["adapted"]][-1].colors)


def test_bands_hold_the_kept_points_by_confidence(opened):
    layer = next(x for x in opened.layers if x.stage.key == "adapted")
    kept = layer.stage.world_points()[layer.stage.keep].astype(np.float32)
    conf_of = dict(zip(map(tuple, kept), layer.stage.conf[layer.stage.keep], strict=True))
    bands = [list(map(tuple, handle.points)) for handle in opened.bands[layer.name]]
    assert sorted(itertools.chain(*bands)) == sorted(conf_of)
    conf = [[conf_of[point] for point in band] for band in bands]
    assert all(max(less) <= min(more) for less, more in itertools.pairwise(conf))


def test_cameras_are_handed_over_in_the_right_frame(opened):
    stage = opened.layers[1].stage
    quaternions, places = viewer.camera_poses(stage)
    R = quat_xyzw_to_matrix(quat_wxyz_to_xyzw(torch.from_numpy(quaternions))).numpy()
    for view in range(4):
        T = stage.T_cam_world[view]
        assert np.allclose(R[view].T, T[:3, :3], atol=1e-5)
        assert np.allclose(T[:3, :3] @ places[view] + T[:3, 3], 0, atol=1e-5)


def test_two_folders_are_compared_in_one_frame(example, tmp_path):
    other = write_example(tmp_path / "other", hw=(24, 32), truth=False)
    shown = viewer.open_viewer([example, other], port=free_port())
    try:
        labels = [layer.label for layer in shown.layers]
        assert labels == [
            "frozen (out)", "adapted (out)", "ground truth (out)", "frozen (other)", "adapted (other)",
        ]  # fmt: skip
        assert "error" not in shown.mode.options
        first, second = shown.layers[1].stage, shown.layers[4].stage
        assert np.allclose(first.T_cam_world, second.T_cam_world, atol=1e-3)
    finally:
        shown.close()


def test_pieces_are_chosen_one_at_a_time(tmp_path):
    frames, cut = 180, 4
    folders = write_sequence(tmp_path / "out", frames, hw=(12, 16), cut=cut)
    shown = viewer.open_viewer(folders[:1], port=free_port())
    try:
        assert [layer.label for layer in shown.layers] == ["frozen (piece 1)", "frozen (piece 2)"]
        assert shown.follow.options[-1] == "frame 71: frame_00071.jpg"
        first, second = (layer.name for layer in shown.layers)
        assert visible(shown.frusta[first]) == 72 and visible(shown.frusta[second]) == 0
        shown.follow.value = shown.follow.options[3]
        shown.shown.value = "frozen (piece 2)"
        assert shown.follow.value == viewer.OUTSIDE
        assert shown.follow.options[1] == "frame 72: frame_00072.jpg"
        assert visible(shown.bands[first]) == 0 and visible(shown.bands[second]) == viewer.BANDS
        # Of the 108 cameras, 100 and the line through all of them.
        assert visible(shown.frusta[second]) == viewer.MOST_CAMERAS + 1
        # Both are shown level, in the same place and at the same size.
        extents = [viewer._extent(layer.stage) for layer in shown.layers]
        for one, other in zip(*extents, strict=True):
            assert np.allclose(one, other, atol=1e-3)
    finally:
        shown.close()


def test_the_mesh_follows_its_points(tmp_path):
    import trimesh

    folder = write_example(tmp_path / "out", hw=(24, 32))
    from freegeo.export.reconstruction import Reconstruction
    from freegeo.report.result import Stage

    own = Reconstruction.load(folder)
    raw = Stage(
        key="adapted", depth_z=own.depth_z, conf=own.conf, T_cam_world=own.T_cam_world, K=own.K, keep=own.conf > 0,
        removed={},
    )  # fmt: skip
    corners = raw.world_points()[0][[0, 0, 5], [0, 5, 0]]
    trimesh.Trimesh(corners, [[0, 1, 2]], process=False).export(folder / "mesh.ply")
    shown = viewer.open_viewer([folder], port=free_port())
    try:
        layer = next(x for x in shown.layers if x.stage.key == "adapted")
        mesh = trimesh.load_mesh(io.BytesIO(shown.meshes[layer.name].glb_data), file_type="glb")
        assert np.allclose(mesh.vertices, layer.stage.world_points()[0][[0, 0, 5], [0, 5, 0]], atol=1e-4)
        assert list(shown.meshes) == [layer.name]
    finally:
        shown.close()


def test_the_panel_says_whether_it_helped(example):
    result = viewer.load_result(example)
    assert viewer.answer_text(result) is None
    scores = {"epipolar_px": 2.0, "reprojection_px": 3.0, "depth_agreement": 0.9, "matches": 1200}
    told = {"accepted": True, "reason": "So.", "probability": 1.0, "before": scores, "after": scores}
    text = viewer.answer_text(dataclasses.replace(result, summary={**result.summary, "refinement": told}))
    assert text is not None and text.startswith("**Refinement: yes.** So.")
    assert "**refined (used)**: epipolar error 2.00 px, contradicted pixels 10.0 %, 1,200 matches" in text


def test_a_port_in_use_is_one_sentence(example):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"port {port} on 127.0.0.1 cannot be used.*--port"):
            viewer.open_viewer([example], port=port)


def test_a_host_without_address_is_one_sentence(example, monkeypatch):
    def no_such_name(*arguments, **options):
        raise socket.gaierror

    monkeypatch.setattr(socket, "getaddrinfo", no_such_name)
    with pytest.raises(UserError, match="--host nowhere: no such address"):
        viewer.open_viewer([example], host="nowhere", port=8080)


def test_what_cannot_be_shown_is_refused(example, tmp_path):
    with pytest.raises(UserError, match="--port must be"):
        viewer.open_viewer([example], port=0)
    with pytest.raises(UserError, match="holds no reconstruction"):
        viewer.open_viewer([tmp_path], port=free_port())
    dataclasses.replace(room(2), T_cam_world=None, K=None).save(tmp_path)
    with pytest.raises(UserError, match="no cameras"):
        viewer.open_viewer([tmp_path], port=free_port())
    other = write_example(tmp_path / "other", hw=(24, 32), names=("another.jpg",))
    with pytest.raises(UserError, match="other photos"):
        viewer.open_viewer([example, other], port=free_port())


class _Closed:
    def close(self):
        self.closed = True


@pytest.mark.parametrize(("host", "warns"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_the_command_says_where_to_look_and_warns(monkeypatch, capsys, tmp_path, host, warns):
    def interrupted():
        raise KeyboardInterrupt

    handle = _Closed()
    monkeypatch.setattr(viewer, "open_viewer", lambda folders, host, port: handle)
    monkeypatch.setattr(command, "wait", interrupted)
    command.view(tmp_path, host=host, port=8123)
    said = capsys.readouterr()
    assert "http://localhost:8123" in said.out
    assert ("no password" in said.err) == warns
    assert ("ssh -L 8123:localhost:8123" in said.out) != warns
    assert handle.closed
    with pytest.raises(UserError, match="name one output folder"):
        command.view()


# -- other web pages


def handshake(port: int, origins: list[str], host: str, upgrade: str = "websocket") -> int:
    """Open a websocket as a browser does, and return the status of the answer."""
    import viser

    lines = [
        "GET / HTTP/1.1", f"Host: {host}", f"Upgrade: {upgrade}", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", f"Sec-WebSocket-Protocol: viser-v{viser.__version__}",
        *(f"Origin: {origin}" for origin in origins),
    ]  # fmt: skip
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        with connection.makefile("rb") as answer:
            return int(answer.readline().split()[1])


def test_a_foreign_page_gets_no_scene(example, caplog):
    port = free_port()
    shown = viewer.open_viewer([example], port=port)
    try:
        own = f"localhost:{port}"
        for host in (own, f"127.0.0.1:{port}", f"[::1]:{port}", "localhost:9000"):  # the last one through a tunnel
            assert handshake(port, [f"http://{host}"], host) == 101, host
        assert not caplog.text
        foreign = (
            ["https://evil.example"], ["null"], ["file://"], [], ["http://localhost:3000"], [f"http://{own}.evil.example"],
            [f"http://{own}@evil.example"], [f"ftp://{own}"], ["https://evil.example", f"http://{own}"], ["http://["],
        )  # fmt: skip
        for origins in foreign:
            assert handshake(port, origins, own) == 403, origins
        assert handshake(port, ["https://evil.example"], own, upgrade="WebSocket") == 403
        # A name of somebody else that is made to lead here is the same for the browser, but not for us.
        assert handshake(port, [f"http://evil.example:{port}"], f"evil.example:{port}") == 403
        assert "refused a request of the page 'https://evil.example'" in caplog.text
        assert caplog.text.count("'https://evil.example'.") == 1
    finally:
        shown.close()


def test_pages_of_a_viewer_for_other_machines():
    for name in ("192.168.1.7:8080", "gpu.lab:8080", socket.gethostname(), "[fe80::1]:8080"):
        assert is_own_page([f"http://{name}"], [name.upper()], "gpu.lab"), name
    assert not is_own_page(["http://gpu.lab:8080"], ["gpu.lab:8080"], "0.0.0.0")
    assert not is_own_page(["http://10.0.0.1:8080"], ["192.168.1.7:8080"], "0.0.0.0")


def test_a_viewer_that_cannot_be_guarded_is_refused():
    with pytest.raises(FreeGeoError, match="cannot be guarded"), own_pages_only("localhost"):
        pass
