"""Pictures of a report: colour-coded maps as data URIs, curves and plans as SVG in the page's colours."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from freegeo.report.result import Result, Stage, even_choice
from freegeo.report.scene3d import level_rotation
from freegeo.report.sequence import Course, view_numbers

MAX_WIDTH = 320
"""Widest embedded picture; with many views they become narrower, so that the page stays small."""
SMALL_WIDTH = 160
"""Up to this width pictures are stored without loss."""
INVALID_GREY = 128
MOST_STROKES = 100
"""Cameras whose viewing directions are drawn."""
MOST_NUMBERED = 12
"""Chunks whose numbers are written into the drawing."""
DEPTH_MAP, CONF_MAP, ERROR_MAP, CHANGE_MAP = "viridis_r", "cividis", "inferno", "RdBu_r"
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


def log_range(maps: Sequence[np.ndarray]) -> tuple[float, float]:
    """Common range of positive maps, from the 2nd to the 98th percentile; (1, 2) without valid values."""
    values = np.concatenate([m[np.isfinite(m) & (m > 0)].ravel() for m in maps])
    if values.size == 0:
        return 1.0, 2.0
    low, high = (float(v) for v in np.quantile(values, (0.02, 0.98)))
    return (low, high) if high > low * 1.0001 else (low / 1.05, high * 1.05)


def log_colours(values: np.ndarray, limits: tuple[float, float], name: str) -> np.ndarray:
    """Colours (..., 3) uint8 of positive values on a logarithmic scale; what is not positive or finite is grey."""
    usable = np.isfinite(values) & (values > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(values / limits[0]) / np.log(limits[1] / limits[0])
    return _coloured(share, usable, name)


def linear_colours(values: np.ndarray, limits: tuple[float, float], name: str) -> np.ndarray:
    """Colours (..., 3) uint8 of values on a linear scale; what is not finite is grey."""
    return _coloured((values - limits[0]) / (limits[1] - limits[0]), np.isfinite(values), name)


def _coloured(share: np.ndarray, usable: np.ndarray, name: str) -> np.ndarray:
    from matplotlib import colormaps

    table = (colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255).round().astype(np.uint8)
    index = np.clip(np.where(usable, share, 0) * 255, 0, 255).astype(np.uint8)
    return np.where(usable[..., None], table[index], np.uint8(INVALID_GREY))


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
    """SVG of the camera positions and directions from above, every stage in its colour, views joined in order."""
    final = result.final
    assert final.T_cam_world is not None
    level = level_rotation(final.T_cam_world)
    with _figure(5.6, 4.4) as (fig, axes):
        reach, numbers = _reach(result, level), view_numbers(result)
        for stage in result.stages.values():
            _draw_cameras(axes, stage, level, 0.1 * reach, numbers)
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.set_xlabel("to the right")
        axes.set_ylabel("forward")
        axes.legend(frameon=False, labelcolor=_INK)
        return _svg(fig)


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


def _draw_cameras(axes: Any, stage: Stage, level: np.ndarray, length: float, numbers: list[str]) -> None:
    places, directions = _plan(stage, level)
    colour = _STAGE_INK[stage.key]
    shown = even_choice(len(places), MOST_STROKES)
    axes.plot(*places.T, "-", color=colour, linewidth=0.8, alpha=0.6)
    axes.plot(*places[shown].T, "o", color=colour, markersize=3.2, label=stage.label)
    tips = places + length * directions
    for view in shown:
        axes.plot(*np.stack((places[view], tips[view])).T, "-", color=colour, linewidth=1.4)
    if stage.key != "truth":
        for view in sorted({0, len(places) - 1}):
            axes.annotate(numbers[view], places[view], xytext=(4, 4), textcoords="offset points", color=colour)


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
        for row, label in bad[:MOST_NUMBERED]:
            axes.annotate(label, places[row], xytext=(6, -13), textcoords="offset points", color=_DOUBT)
        for part in even_choice(len(course.parts), MOST_NUMBERED):
            number, rows = course.parts[part]
            colour = _CHUNK_INK[number % len(_CHUNK_INK)]
            place = places[rows[len(rows) // 2]]
            axes.annotate(str(number), place, xytext=(4, 4), textcoords="offset points", color=colour)
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.set_xlabel("to the right")
        axes.set_ylabel("forward")
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            # Above the drawing, where it covers nothing of it.
            fig.legend(handles, labels, loc="outside upper left", ncols=3, frameon=False, labelcolor=_INK)
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
