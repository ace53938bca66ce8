"""Pictures of a report: colour-coded maps as data URIs, curves and plans as SVG in the page's colours."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from freegeo.export.colours import coloured
from freegeo.export.reconstruction import Reconstruction
from freegeo.report.result import Result, Stage, even_choice
from freegeo.report.scene3d import level_rotation
from freegeo.report.sequence import Course, view_numbers

MAX_WIDTH = 320
"""Widest embedded picture; with many views they become narrower, so that the page stays small."""
SMALL_WIDTH = 160
"""Up to this width pictures are stored without loss."""
MOST_STROKES = 100
"""Cameras whose viewing directions are drawn."""
MOST_NUMBERED = 16
"""Chunks or cameras whose numbers are written into a drawing."""
CONF_MAP, ERROR_MAP, CHANGE_MAP = "cividis", "inferno", "RdBu_r"
# Placeholders that the page's colours replace, so that one figure works in light and dark mode.
_INK, _FAINT = "#010203", "#040506"
_STAGE_INK = {"frozen": "#070809", "adapted": "#0a0b0c", "refined": "#101112", "truth": "#0d0e0f"}
_DOUBT, _CARD, _SOFT = "#131415", "#161718", "#2b2c2d"
_CHUNK_INK = ("#191a1b", "#1c1d1e", "#1f2021", "#222324", "#252627", "#28292a")
_PAGE_COLOURS = {
    _INK: "currentColor",
    _FAINT: "var(--line)",
    _DOUBT: "var(--doubt)",
    _CARD: "var(--card)",
    _SOFT: "var(--soft)",
    **{ink: f"var(--chunk{number})" for number, ink in enumerate(_CHUNK_INK)},
    **{ink: f"var(--{key})" for key, ink in _STAGE_INK.items()},
}


def linear_colours(values: np.ndarray, limits: tuple[float, float], name: str) -> np.ndarray:
    """Colours (..., 3) uint8 of values on a linear scale; what is not finite is grey."""
    return coloured((values - limits[0]) / (limits[1] - limits[0]), np.isfinite(values), name)


def gradient(name: str) -> str:
    """The colours of a map as a CSS gradient, for a legend."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    stops = ", ".join(to_hex(colormaps[name](share)) for share in np.linspace(0, 1, 9))
    return f"linear-gradient(to right, {stops})"


def data_uri(image: np.ndarray, max_width: int = MAX_WIDTH) -> str:
    """An RGB image (H, W, 3) uint8 as a data URI: PNG when it is small, JPEG of at most `max_width` otherwise."""
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(image))
    small = picture.width <= SMALL_WIDTH
    if picture.width > max_width:
        height = max(1, round(picture.height * max_width / picture.width))
        picture = picture.resize((max_width, height), Image.Resampling.BOX)
    buffer = io.BytesIO()
    if small:
        picture.save(buffer, "PNG", optimize=True)
    else:
        picture.save(buffer, "JPEG", quality=82, optimize=True)
    kind = "png" if small else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def photo_as_seen(pixels: np.ndarray, reconstruction: Reconstruction, view: int, longest: int) -> np.ndarray:
    """Return the part of a photo that the model saw, (h, w, 3) uint8, finer than the model saw it; padding is white.

    Args:
        pixels: (H, W, 3) uint8 of the whole photo.
        reconstruction: says where the model's pixels lie in it.
        view: number of the photo.
        longest: most pixels of the longer side; of a smaller photo, as many as it has.
    """
    from PIL import Image

    scale, offset = reconstruction.scale_xy[view], reconstruction.offset_xy[view]
    start = -offset / scale
    size = np.array(reconstruction.image_hw[::-1]) / scale
    factor = min(1.0, longest / size.max())
    ends = np.stack((np.maximum(start, 0), np.minimum(start + size, pixels.shape[1::-1])))
    place = ((ends - start) * factor).round().astype(int)
    canvas = Image.new("RGB", tuple(np.maximum((size * factor).round().astype(int), 1).tolist()), "white")
    if (place[1] > place[0]).all():
        part = Image.fromarray(pixels).resize(
            tuple((place[1] - place[0]).tolist()), Image.Resampling.BICUBIC, box=tuple(ends.ravel().tolist()),
            reducing_gap=3.0,
        )  # fmt: skip
        canvas.paste(part, tuple(place[0].tolist()))
    return np.asarray(canvas)


def loss_curve(curve: Sequence[Mapping[str, float]]) -> str:
    """SVG of the adaptation loss over the steps: the total, and its parts."""
    with _figure(5.6, 2.9) as (fig, axes):
        steps = np.arange(1, len(curve) + 1)
        for term, style in (("total", "-"), ("cross", "--"), ("intra", ":"), ("hold", "-.")):
            values = np.array([step.get(term, np.nan) for step in curve], dtype=float)
            if np.isfinite(values).any():
                width = 1.8 if term == "total" else 1.1
                axes.plot(steps, values, style, color=_STAGE_INK["adapted"], linewidth=width, label=term)
        axes.set_xlabel("step")
        axes.set_ylabel("loss")
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False, labelcolor=_INK)
        return _svg(fig)


def camera_plan(result: Result) -> str:
    """SVG of the camera positions and directions from above, every stage in its colour, the result's numbered."""
    final = result.final
    assert final.T_cam_world is not None
    level = level_rotation(final.T_cam_world)
    numbers = view_numbers(result)
    with _figure(5.6, 4.8) as (fig, axes):
        reach = _reach(result, level)
        for stage in result.stages.values():
            _draw_cameras(axes, stage, level, 0.1 * reach, with_line=result.is_path)
        _map_axes(fig, axes)
        places, _ = _plan(final, level)
        shown = even_choice(len(places), MOST_NUMBERED)
        if result.summary.get("sequence"):
            shown = sorted({0, len(places) - 1})
        ink = _STAGE_INK[final.key]
        ends = [(p, p + 0.1 * reach * d) for p, d in (_plan(stage, level) for stage in result.stages.values())]
        strokes = np.concatenate([start + share * (end - start) for start, end in ends for share in (0, 0.3, 0.6, 1)])
        _write_beside(fig, axes, [(places[view], numbers[view], ink) for view in shown], avoid=strokes)
        return _svg(fig)


def _map_axes(fig: Any, axes: Any) -> None:
    """Give a drawing from above its axes, and its legend outside, where it covers nothing."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set_xlabel("to the right")
    axes.set_ylabel("forward")
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        fig.legend(handles, labels, loc="outside upper left", ncols=3, frameon=False, labelcolor=_INK)


def _write_beside(
    fig: Any, axes: Any, texts: Sequence[tuple[np.ndarray, str, str]], avoid: np.ndarray, height: float = 10.0
) -> None:
    """Write texts (place, text, colour) beside their places, in the order given, where they cover nothing.

    Each is put where it covers no text before it and the fewest of the points to avoid; one that finds no place without
    a text is left out.

    Args:
        fig: whose layout is final but for the texts.
        axes: of the figure, with everything else drawn.
        texts: place (2,), text and colour.
        avoid: (n, 2) points of the drawing.
        height: of the letters, in points.
    """
    fig.draw_without_rendering()
    unit = fig.dpi / 72
    points = axes.transData.transform(avoid) / unit
    frame = axes.get_window_extent().extents / unit
    taken: list[tuple[float, float, float, float]] = []
    for place, text, colour in texts:
        x, y = axes.transData.transform(place) / unit
        width, best = 0.62 * height * len(text), None
        for away in (5.0, 12.0, 20.0):
            for dx, dy in ((1, 1), (1, -1), (-1, 1), (-1, -1), (0, 1), (0, -1), (1, 0), (-1, 0)):
                left = x + away * dx + width * (dx - 1) / 2
                low = y + away * dy + height * (dy - 1) / 2
                box = (left, low, left + width, low + height)
                outside = box[0] < frame[0] or box[1] < frame[1] or box[2] > frame[2] or box[3] > frame[3]
                if outside or any(_overlap(box, other) for other in taken):
                    continue
                covered = ((points > (box[0] - 2, box[1] - 2)) & (points < (box[2] + 2, box[3] + 2))).all(1).sum()
                if best is None or (covered, away) < best[:2]:
                    best = (int(covered), away, box)
        if best is not None:
            taken.append(best[2])
            axes.annotate(
                text, place, xytext=(best[2][0] - x, best[2][1] - y), textcoords="offset points", color=colour,
                fontsize=height, ha="left", va="baseline",
            )  # fmt: skip


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _reach(result: Result, level: np.ndarray) -> float:
    spans = [np.ptp(_plan(stage, level)[0], axis=0).max() for stage in result.stages.values()]
    return float(max(spans)) or 1.0


def _plan(stage: Stage, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and viewing directions (S, 2) seen from above: right, forward."""
    assert stage.T_cam_world is not None
    R = stage.T_cam_world[:, :3, :3].astype(np.float64)
    centres = -np.einsum("sij,si->sj", R, stage.T_cam_world[:, :3, 3].astype(np.float64)) @ level.T
    directions = R[:, 2] @ level.T
    return centres[:, (0, 2)] * (1, -1), directions[:, (0, 2)] * (1, -1)


def _draw_cameras(axes: Any, stage: Stage, level: np.ndarray, length: float, *, with_line: bool) -> None:
    places, directions = _plan(stage, level)
    colour = _STAGE_INK[stage.key]
    shown = even_choice(len(places), MOST_STROKES)
    if with_line:
        axes.plot(*places.T, "-", color=colour, linewidth=0.8, alpha=0.6)
    axes.plot(*places[shown].T, "o", color=colour, markersize=3.2, label=stage.label)
    tips = places + length * directions
    for view in shown:
        axes.plot(*np.stack((places[view], tips[view])).T, "-", color=colour, linewidth=1.4)


def trajectory(result: Result, course: Course) -> str:
    """SVG of the cameras' path from above, each chunk in a colour, with seams and loops."""
    final = result.final
    assert final.T_cam_world is not None
    level = level_rotation(final.T_cam_world)
    places, _ = _plan(final, level)
    with _figure(5.6, 4.8) as (fig, axes):
        if result.truth is not None and result.truth.T_cam_world is not None:
            axes.plot(
                *_plan(result.truth, level)[0].T, "-", color=_STAGE_INK["truth"], linewidth=0.9, label="ground truth"
            )
        for number, rows in course.parts:
            axes.plot(*places[rows].T, "-", color=_CHUNK_INK[number % len(_CHUNK_INK)], linewidth=2.2)
        for used, colour, style, label in ((True, _INK, "--", "loop"), (False, _SOFT, ":", "loop, not used")):
            for first, second in ((a, b) for a, b, is_used in course.loops if is_used == used):
                axes.plot(*places[[first, second]].T, style, color=colour, linewidth=1.2, label=label)
                label = None
        good = [row for row, used, _ in course.seams if used]
        if good:
            axes.plot(*places[good].T, "o", markersize=4, color=_CARD, markeredgecolor=_INK, label="seam")
        bad = [(row, label) for row, used, label in course.seams if not used]
        if bad:
            rows = [row for row, _ in bad]
            axes.plot(*places[rows].T, "X", markersize=9, color=_DOUBT, markeredgecolor=_CARD, label="seam, not used")
        _map_axes(fig, axes)
        texts = [(places[row], label, _DOUBT) for row, label in bad[:MOST_NUMBERED]]
        for part in even_choice(len(course.parts), MOST_NUMBERED):
            number, rows = course.parts[part]
            texts.append((places[rows[len(rows) // 2]], str(number), _CHUNK_INK[number % len(_CHUNK_INK)]))
        between = [(1 - share) * places[:-1] + share * places[1:] for share in (0, 0.25, 0.5, 0.75)]
        _write_beside(fig, axes, texts, avoid=np.concatenate([*between, places[-1:]]))
        return _svg(fig)


@contextmanager
def _figure(width: float, height: float) -> Generator[tuple[Any, Any]]:
    """A figure and its axes, without background, whose ink is replaced by the page's colours."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    settings: Any = {
        **{"svg.fonttype": "none", "svg.hashsalt": "freegeo", "font.size": 10},
        **dict.fromkeys(("text.color", "xtick.color", "ytick.color", "axes.labelcolor"), _INK),
        **{"axes.edgecolor": _FAINT, "grid.color": _FAINT, "axes.grid": True, "grid.linewidth": 0.6},
        **{"axes.spines.top": False, "axes.spines.right": False},
    }
    with mpl.rc_context(settings):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, figure.subplots()


def _svg(figure: Any) -> str:
    """A figure as inline SVG without a fixed size, in the page's colours."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    # Inline SVG needs no XML header, and the metadata holds URLs.
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    opening, rest = text.split(">", 1)
    attributes = [part for part in opening.split() if not part.startswith(("width=", "height="))]
    text = " ".join(attributes) + ' role="img">' + rest
    for ink, colour in _PAGE_COLOURS.items():
        text = text.replace(ink, colour)
    return text
