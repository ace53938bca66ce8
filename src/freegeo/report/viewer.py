"""The interactive viewer: one or two output folders in a browser, through viser.

Points are grouped into bands of confidence. Moving the confidence slider only hides and shows bands that the browser
already has, so it is fast over a slow connection too. Pieces of a sequence are shown one at a time: nothing is known of
how they lie to each other.
"""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from freegeo.errors import UserError
from freegeo.export.colours import DEPTH_MAP, log_colours, log_range
from freegeo.export.mesh import FILE_NAME as MESH_NAME
from freegeo.export.mesh import load_mesh
from freegeo.geometry.rotation import matrix_to_quat_xyzw, quat_xyzw_to_wxyz
from freegeo.geometry.sim3 import Sim3
from freegeo.report import sequence
from freegeo.report.answer import answer
from freegeo.report.figures import CONF_MAP, ERROR_MAP, linear_colours
from freegeo.report.origin import own_pages_only, require_free_port
from freegeo.report.result import Result, Stage, even_choice, load_result, moved, moved_by
from freegeo.report.scene3d import (
    ERROR_LIMIT,
    MOST_CAMERAS,
    first_view,
    frustum_depth,
    kept_points,
    level_rotation,
)

logger = logging.getLogger(__name__)

BANDS = 20
MAX_POINTS = 600_000
"""Most points of one stage that are sent to the browser; of more, a seeded choice."""
THUMBNAIL_WIDTH = 240
FRUSTUM_SHARE = 0.06
FIRST_FOV, FIRST_ASPECT = np.deg2rad(50), 1.0
"""Of the first view; browser windows are broader, but their right end is the panel's."""
STAGE_COLOURS = {
    "frozen": (214, 122, 32), "adapted": (42, 124, 204), "refined": (150, 70, 190), "truth": (64, 160, 92),
}  # fmt: skip
SCREENSHOT_HW = (1080, 1920)
OUTSIDE = "outside"
MODES = ("photo", "depth", "confidence", "error")
Ranges = dict[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One stage of one folder, as it is listed in the viewer."""

    label: str
    name: str
    """Path of its nodes in the scene."""
    stage: Stage
    result: Result


class Viewer:
    """A running viewer; `close` ends it."""

    def __init__(self, results: Sequence[Result], *, names: Sequence[str], host: str, port: int):
        """Start it; `names` tell results apart where there are several."""
        viser = _viser()
        self.layers = _layers(results, names)
        # viser prints its address to stdout, which the command reports itself.
        with redirect_stdout(io.StringIO()), own_pages_only(host):
            self.server = viser.ViserServer(host=host, port=port, label="freegeo", verbose=False)
        # A column of its own, under which nothing of the scene lies.
        self.server.gui.main_panel.dock_right()
        self.bands: dict[str, list[Any]] = {}
        self.colours: dict[str, dict[str, list[np.ndarray]]] = {}
        self.frusta: dict[str, list[Any]] = {}
        self.meshes: dict[str, Any] = {}
        self._place(results[0])
        ranges = {
            "depth": log_range(lambda: (layer.stage.depth_z for layer in self.layers)),
            "confidence": log_range(lambda: (layer.stage.conf for layer in self.layers)),
        }
        for layer in self.layers:
            self._add(layer, ranges)
        for result, name in zip(results, names, strict=True):
            text = answer_text(result)
            if text is not None:
                with self.server.gui.add_folder("Did it help?" if len(results) == 1 else name):
                    self.server.gui.add_markdown(text)
        told = sequence.told(results[0])
        if told is not None:
            with self.server.gui.add_folder("Sequence", expand_by_default=bool(told.problems)):
                self.server.gui.add_markdown("\n\n".join([" ".join(told.sentences), *told.problems]))
        self._add_controls()
        self._apply()

    def close(self) -> None:
        """Stop serving."""
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def _place(self, result: Result) -> None:
        """Choose up, size and the first view from the final cameras and points."""
        final = result.final
        level, centre, self.radius = _extent(final)
        self.spacing = _spacing(final)
        self.server.scene.set_up_direction(level[1])
        self.server.scene.configure_default_lights(cast_shadow=False)
        first = self.server.initial_camera
        frusta = frustum_depth(final, FRUSTUM_SHARE * self.radius)
        eye, first.look_at = first_view(final, level, centre, frusta=frusta, fov=FIRST_FOV, aspect=FIRST_ASPECT)
        first.position = eye
        first.fov = FIRST_FOV
        first.up = level[1]
        first.near, first.far = 1e-3 * self.radius, 1e3 * self.radius

    def _add(self, layer: Layer, ranges: Ranges) -> None:
        points, colours, order = _banded(layer.stage, layer.result.images, ranges)
        self.colours[layer.name] = colours
        self.bands[layer.name] = [
            self.server.scene.add_point_cloud(
                f"{layer.name}/points/{band:02d}", points[rows], colours["photo"][band], point_size=self.spacing,
                point_shape="circle", point_shading="flat", precision="float32",
            )
            for band, rows in enumerate(order)
        ]  # fmt: skip
        self.frusta[layer.name] = list(self._add_frusta(layer))
        mesh = _mesh(layer)
        if mesh is not None:
            self.meshes[layer.name] = self.server.scene.add_mesh_trimesh(f"{layer.name}/mesh", mesh)

    def _add_frusta(self, layer: Layer) -> Iterator[Any]:
        stage = layer.stage
        assert stage.T_cam_world is not None
        assert stage.K is not None
        height, width = stage.depth_z.shape[1:]
        poses, places = camera_poses(stage)
        images = layer.result.full[layer.result.final.key].images
        colour, scale = STAGE_COLOURS[stage.key], frustum_depth(stage, FRUSTUM_SHARE * self.radius)
        for view in even_choice(len(places), MOST_CAMERAS):
            handle = self.server.scene.add_camera_frustum(
                f"{layer.name}/cameras/{view:03d}", fov=field_of_view(stage, view), aspect=width / height, scale=scale,
                thickness=0.002 * self.radius, color=colour, image=_thumbnail(images[view]), format="jpeg",
                wxyz=poses[view], position=places[view], cast_shadow=False,
            )  # fmt: skip
            handle.on_click(lambda _, view=view: self._set_follow(view))
            yield handle
        if len(places) > MOST_CAMERAS and layer.result.is_path:
            ends = np.stack((places[:-1], places[1:]), axis=1)
            yield self.server.scene.add_line_segments(f"{layer.name}/path", ends, colour, thickness=0.004 * self.radius)

    def _add_controls(self) -> None:
        gui = self.server.gui
        labels = [layer.label for layer in self.layers]
        final = next(layer.label for layer in self.layers if layer.stage is layer.result.final)
        self.shown = gui.add_dropdown("Shown", labels, initial_value=final)
        self.swap = gui.add_button("Swap before / after", disabled=len({layer.stage.key for layer in self.layers}) < 2)
        modes = [m for m in MODES if all(m in colours for colours in self.colours.values())]
        self.mode = gui.add_dropdown("Colour", modes, initial_value="photo")
        self.hidden = gui.add_slider("Hide least confident %", 0, 95, 5, 0)
        self.size = gui.add_slider("Point size", 0.2, 6.0, 0.1, 1.5)
        self.with_points = gui.add_checkbox("Points", True)
        self.with_cameras = gui.add_checkbox("Cameras", True)
        self.with_mesh = gui.add_checkbox("Mesh", False, visible=bool(self.meshes))
        self.follow = gui.add_dropdown("Follow camera", _choices(self.layers[0].result), initial_value=OUTSIDE)
        picture = gui.add_button("Save screenshot")
        for control in (self.shown, self.size, self.hidden, self.with_points, self.with_cameras, self.with_mesh):
            control.on_update(lambda _: self._apply())
        self.mode.on_update(lambda _: self._recolour())
        self.follow.on_update(lambda _: self._apply())
        self.server.on_client_connect(lambda _: self._go_to_camera())
        self.swap.on_click(lambda _: self._swap())
        picture.on_click(lambda event: self._screenshot(event.client))

    def _layer(self) -> Layer:
        return next(layer for layer in self.layers if layer.label == self.shown.value)

    def _apply(self) -> None:
        """Update the scene from the controls."""
        chosen = self._layer()
        choices = _choices(chosen.result)
        if list(self.follow.options) != choices:
            # Another piece, with frames of its own.
            self.follow.options = choices
        first_band = round(self.hidden.value / 100 * BANDS)
        # Seen from one of the cameras, frusta and their pictures would hide the points.
        cameras = self.with_cameras.value and self.follow.value == OUTSIDE
        with self.server.atomic():
            for layer in self.layers:
                here = layer is chosen
                for band, handle in enumerate(self.bands[layer.name]):
                    handle.visible = here and self.with_points.value and band >= first_band
                    handle.point_size = self.size.value * self.spacing
                for handle in self.frusta[layer.name]:
                    handle.visible = here and cameras
                if layer.name in self.meshes:
                    self.meshes[layer.name].visible = here and self.with_mesh.value
        self._go_to_camera()

    def _recolour(self) -> None:
        with self.server.atomic():
            for name, handles in self.bands.items():
                for handle, colours in zip(handles, self.colours[name][self.mode.value], strict=True):
                    handle.colors = colours

    def _swap(self) -> None:
        """Show the next prediction of the same folder."""
        now = self._layer()
        own = [x for x in self.layers if x.result is now.result and (x.stage.key != "truth" or x is now)]
        self.shown.value = own[(own.index(now) + 1) % len(own)].label

    def _set_follow(self, view: int) -> None:
        self.follow.value = self.follow.options[view + 1]

    def _go_to_camera(self) -> None:
        """Move the view of every connected browser to the pose of the chosen camera."""
        view = self.follow.options.index(self.follow.value) - 1
        if view < 0:
            return
        stage = self._layer().stage
        poses, places = camera_poses(stage)
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.wxyz = poses[view]
                client.camera.position = places[view]
                client.camera.fov = field_of_view(stage, view)

    def _screenshot(self, client: Any) -> None:
        if client is None:
            return
        from PIL import Image

        height, width = SCREENSHOT_HW
        picture = client.get_render(height=height, width=width, transport_format="jpeg")
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "PNG")
        client.send_file_download("freegeo.png", buffer.getvalue(), save_immediately=True)


def open_viewer(folders: Sequence[Path], *, host: str = "127.0.0.1", port: int) -> Viewer:
    """Serve one or two output folders of the same photos; returns at once, the server runs in a thread of its own.

    Args:
        folders: output folders; the second is moved and scaled onto the first. Of one folder, the other pieces of a
            sequence are shown too.
        host: address to listen on. Other than localhost, everybody who reaches it sees the photos. Browsers get the
            scene for the viewer's own page only (`report.origin`).
        port: to listen on.

    Raises:
        UserError: viser is not installed, the port is in use or out of range, a folder holds no reconstruction, has no
            cameras, or the two folders show different photos.
        FreeGeoError: a damaged file.
    """
    if not 1 <= len(folders) <= 2:
        raise UserError(f"The viewer shows one or two output folders, got {len(folders)}.")
    _viser()
    require_free_port(host, port)
    results = [load_result(Path(folder)) for folder in folders]
    for result in results:
        if not result.has_cameras:
            raise UserError(f"{result.folder}: has no cameras, so there is nothing to show in 3D.")
    others = sequence.piece_folders(results[0])
    if len(results) == 2:
        if list(results[0].names) != list(results[1].names):
            raise UserError(
                f"{results[1].folder}: shows other photos than {results[0].folder}; compare runs of one scene."
            )
        results[1] = moved(results[1], onto=results[0].final)
        names = _folder_names(results)
        if others:
            logger.warning("only the first pieces are compared; view one folder alone to see all of its pieces.")
    else:
        results += [_beside(load_result(other), results[0]) for other in others]
        names = [f"piece {number + 1}" for number in range(len(results))]
    return Viewer(results, names=names, host=host, port=port)


def _beside(piece: Result, first: Result) -> Result:
    """Return a piece levelled, centred and scaled like the first, as its own frame and scale mean nothing beside it."""
    (level, centre, radius), (to_level, to_centre, to_radius) = _extent(piece.final), _extent(first.final)
    scale, R = to_radius / radius, to_level.T @ level
    s, turn, t = (torch.as_tensor(a, dtype=torch.float64) for a in (scale, R, to_centre - scale * R @ centre))
    return moved_by(piece, Sim3(s=s, R=turn, t=t))


def _extent(stage: Stage) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation (3, 3) to a level frame, centre (3,) of the kept points, and a radius that holds most of them."""
    assert stage.T_cam_world is not None
    level = level_rotation(stage.T_cam_world)
    seen = kept_points(stage)
    centre = np.quantile(seen @ level.T, (0.03, 0.97), axis=0).mean(axis=0) @ level
    return level, centre, float(np.quantile(np.linalg.norm(seen - centre, axis=1), 0.9)) or 1.0


def answer_text(result: Result) -> str | None:
    """Whether adaptation and refinement helped, as Markdown for the panel; None where neither was done."""
    found = answer(result.summary)
    if found is None:
        return None
    lines = [f"**{part.what}: {part.outcome}.** {part.sentence}" for part in found.parts]
    lines += [
        f"**{name}**: epipolar error {epipolar} px, contradicted pixels {contradicted} %, {matches} matches"
        for name, epipolar, _, contradicted, matches, _ in found.rows
    ]
    return "\n\n".join(lines + [f"Try: {sentence}" for sentence in found.advice])


def field_of_view(stage: Stage, view: int) -> float:
    """Vertical field of view of a camera in radians."""
    assert stage.K is not None
    return float(2 * np.arctan(stage.depth_z.shape[1] / 2 / stage.K[view, 1, 1]))


def camera_poses(stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Orientation camera -> world as quat_wxyz (S, 4) and position (S, 3), which is how viser takes cameras."""
    assert stage.T_cam_world is not None
    R = torch.from_numpy(stage.T_cam_world[:, :3, :3]).double().mT
    places = -np.einsum("sij,sj->si", R.numpy(), stage.T_cam_world[:, :3, 3].astype(np.float64))
    return quat_xyzw_to_wxyz(matrix_to_quat_xyzw(R)).numpy(), places


def _layers(results: Sequence[Result], names: Sequence[str]) -> list[Layer]:
    layers, photos = [], set()
    for number, (result, name) in enumerate(zip(results, names, strict=True)):
        for stage in result.stages.values():
            # Two results of the same photos have one ground truth.
            if stage.key != "truth" or tuple(result.names) not in photos:
                label = stage.label if len(results) == 1 else f"{stage.label} ({name})"
                layers.append(Layer(label=label, name=f"/{number}/{stage.key}", stage=stage, result=result))
        photos.add(tuple(result.names))
    return layers


def _choices(result: Result) -> list[str]:
    """Where the view can be from: outside, or one of the cameras."""
    numbers = sequence.view_numbers(result)
    return [OUTSIDE, *(f"{number}: {name}" for number, name in zip(numbers, result.names, strict=True))]


def _folder_names(results: Sequence[Result]) -> list[str]:
    names = [result.folder.resolve().name for result in results]
    return names if len(set(names)) == len(names) else [str(result.folder) for result in results]


def _banded(
    stage: Stage, images: np.ndarray, ranges: Ranges
) -> tuple[np.ndarray, dict[str, list[np.ndarray]], list[np.ndarray]]:
    """Kept points (n, 3), their colours per mode and band, and the rows of each band, least confident first."""
    index = np.flatnonzero(stage.keep)
    if len(index) > MAX_POINTS:
        logger.info("%s: %d of %d points are shown", stage.label, MAX_POINTS, len(index))
        index = np.sort(np.random.default_rng(0).choice(index, MAX_POINTS, replace=False))
    points = stage.world_points().reshape(-1, 3)[index]
    depth, conf = stage.depth_z.reshape(-1)[index], stage.conf.reshape(-1)[index]
    colours = {
        "photo": images.reshape(-1, 3)[index],
        "depth": log_colours(depth, ranges["depth"], DEPTH_MAP),
        "confidence": log_colours(conf, ranges["confidence"], CONF_MAP),
    }
    if stage.error is not None:
        colours["error"] = linear_colours(stage.error.reshape(-1)[index], (0, ERROR_LIMIT), ERROR_MAP)
    order = np.array_split(np.argsort(conf, kind="stable"), BANDS)
    return points, {mode: [values[rows] for rows in order] for mode, values in colours.items()}, order


def _spacing(stage: Stage) -> float:
    assert stage.K is not None
    covered = stage.depth_z / np.sqrt(stage.K[:, 0, 0] * stage.K[:, 1, 1])[:, None, None]
    return float(np.median(covered[stage.keep])) if stage.keep.any() else 0.01


def _thumbnail(image: np.ndarray) -> np.ndarray:
    step = max(1, image.shape[1] // THUMBNAIL_WIDTH)
    return np.ascontiguousarray(image[::step, ::step])


def _mesh(layer: Layer) -> Any:
    """The mesh of the folder, which shows the final stage, moved from that stage's own frame to the viewer's."""
    path = layer.result.folder / MESH_NAME
    if layer.stage is not layer.result.final or not path.is_file():
        return None
    mesh = load_mesh(path)
    move = layer.result.from_own_frame
    if move is not None:
        mesh.vertices = move.apply(torch.from_numpy(np.asarray(mesh.vertices, dtype=np.float64))).numpy()
    return mesh


def _viser() -> Any:
    try:
        import viser
    except ImportError:
        raise UserError("The viewer needs an extra: pip install 'freegeo[view]'.") from None
    return viser
