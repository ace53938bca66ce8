"""``report.html``: one self-contained page that shows the settings and results of a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from freegeo import files
from freegeo.export.colours import DEPTH_MAP, log_colours, log_range
from freegeo.export.reconstruction import Reconstruction
from freegeo.report import figures, sequence
from freegeo.report.answer import HEADER, NOTE, TIES, answer, rescaled, ties
from freegeo.report.contents import FILES
from freegeo.report.pairs import PairPicture, pair_pictures
from freegeo.report.rendering import duration, fill
from freegeo.report.result import LABELS, MANY_VIEWS, REPORT_NAME, Result, camera_difference, even_choice, load_result
from freegeo.report.scene3d import ERROR_LIMIT, drawn_cameras, most_kept, scene_data
from freegeo.types import PhotoLike

TEMPLATE = "report.html.j2"
Range = tuple[float, float]
CHANGE_LIMIT = 0.2
"""Relative depth change at the end of the colour scale."""
SOME_VIEWS, NARROW_WIDTH = 16, 224
"""With more than `SOME_VIEWS` views, maps are at most `NARROW_WIDTH` pixels wide."""
PHOTO_SIDE, PHOTO_SIDE_OF_MANY = 720, 512
"""Longer side of the photos, in pixels, up to `SOME_VIEWS` views and with more."""
MOST_AT_ONCE, VIEWS_A_PAGE = 8, 6
"""Views of the gallery that are shown at once: up to the first number all, of more as many as the second."""
MOST_WARNINGS = 12
"""Warnings that are shown at the top; the others are behind a click."""
SCORE_LABELS = {
    "auc03": "AUC@3°", "auc05": "AUC@5°", "auc15": "AUC@15°", "auc30": "AUC@30°", "abs_rel": "depth error (abs-rel)",
    "f1_rel5": "F1 of points",
}  # fmt: skip
FILTER_TEXTS = {
    "invalid depth": "no usable depth",
    "mask": "outside the user's masks",
    "sky or ambiguous": "sky, or pixels that the model calls ambiguous",
    "confidence": "least confident share",
    "flying": "between surfaces (flying pixels)",
    "multi-view": "contradicted by other views",
}


def write_report(
    folder: Path, *, truth: Reconstruction | None = None, photos: Sequence[PhotoLike] | None = None
) -> Path:
    """Write `report.html` of a finished output folder.

    Args:
        folder: holds prediction.npz and, where there, reconstruction.json, frozen/, adapter/ and scores.json.
        truth: ground truth at the prediction's resolution, in any world frame; default: `truth/prediction.npz` of the
            folder, if there.
        photos: of the result, which are shown and in which matches are drawn; None: the images that the model read.

    Raises:
        UserError: no reconstruction there, or one of a newer format.
        FreeGeoError: a damaged file, or ground truth of another size.
    """
    result = load_result(Path(folder), truth=truth)
    pairs = pair_pictures(result.folder, result.full[result.final.key], photos)
    path = result.folder / REPORT_NAME
    with files.atomic_path(path) as part:
        part.write_text(render(result, pairs, photos), encoding="utf-8")
    return path


def render(result: Result, pairs: Sequence[PairPicture] = (), photos: Sequence[PhotoLike] | None = None) -> str:
    """Return the page as text."""
    from markupsafe import Markup

    curve = result.adaptation.get("loss_curve") or []
    course, numbers = sequence.course(result), sequence.view_numbers(result)
    # The trajectory shows the cameras already, unless there are others to compare them with.
    with_plan = result.has_cameras and (course is None or len(result.stages) > 1)
    return fill(
        TEMPLATE,
        title=sequence.title(result),
        facts=facts(result),
        answer=answer(result.summary),
        unasked=unasked(result),
        answer_header=HEADER,
        answer_note=NOTE,
        pairs=pairs,
        warnings=list(result.summary.get("warnings") or []),
        stages=[{"key": s.key, "label": s.label} for s in result.stages.values()],
        predictions=[{"key": s.key, "label": s.label} for s in result.predictions],
        scene=scene_data(result) if result.has_cameras else None,
        most_points=most_kept(result),
        sequence=sequence.told(result),
        trajectory=Markup(figures.trajectory(result, course)) if course and result.has_cameras else None,
        most_warnings=MOST_WARNINGS,
        step=result.step,
        has_error=result.truth is not None,
        views=list(views(result, photos)),
        legends=legends(result),
        view_count=len(numbers),
        shown_views=min(len(numbers), MANY_VIEWS),
        most_at_once=MOST_AT_ONCE,
        views_a_page=VIEWS_A_PAGE,
        is_path=result.is_path,
        own_cameras=[stage.label for stage in result.predictions if stage.own_cameras],
        cameras3d=[f"{numbers[view]}: {result.names[view]}" for view in drawn_cameras(result)],
        plan=Markup(figures.camera_plan(result)) if with_plan else None,
        cameras=camera_rows(result),
        loss=Markup(figures.loss_curve(curve)) if curve else None,
        steps=len(curve),
        taught=bool(curve) and "cameras" in curve[0],
        loss_change=result.summary.get("loss"),
        truth_rows=truth_rows(result),
        scores=score_table(result.scores),
        filters=filter_tables(result),
        seconds=list((result.summary.get("seconds") or {}).items()),
        settings=list(flattened(result.summary.get("settings") or {})),
        adaptation=list(flattened({k: v for k, v in result.adaptation.items() if k not in ("loss_curve", "recipe")})),
        versions=list((result.summary.get("versions") or {}).items()),
        command=result.summary.get("command"),
        files=list(files_beside(result.folder)),
    )


def unasked(result: Result) -> str:
    """Return what stands in the place of the verdict where neither adaptation nor refinement was asked for."""
    if not result.summary:
        return "Nothing is known of how this prediction was made."
    adapter = result.summary.get("adapter")
    if adapter:
        return f"Predicted with the adapter {adapter}. Whether it helps with these photos was not asked."
    return "The model's own prediction: neither adapted to these photos nor refined."


def files_beside(folder: Path) -> Iterator[tuple[str, str, str]]:
    """Files of a result that exist: name, address relative to the page, purpose.

    A later export may write depth files of another size beside this page, so nothing is said of it.
    """
    for name, about in FILES.items():
        path = folder / name
        if name != REPORT_NAME and path.exists():
            yield name, f"{name}/" if path.is_dir() else name, about


def facts(result: Result) -> list[tuple[str, str]]:
    """The key facts at the top of the page, as (name, value)."""
    summary, final = result.summary, result.final
    height, width = result.full[final.key].image_hw
    kept = 1 - sum(final.removed.values()) / result.pixels if final.removed else final.keep.mean()
    found = [
        ("model", str(summary.get("model", "unknown"))),
        ("views", str(len(result.names))),
        ("resolution", f"{width} × {height}"),
        ("lengths", result.lengths),
    ]
    if result.has_cameras:
        found.append(("kept pixels", f"{_percent(kept)} of {result.pixels:,}"))
    if known := summary.get("known_cameras"):
        factor = rescaled(summary)
        more = "" if factor is None else f", positions times {factor:.4g}"
        found.append(("known cameras", f"{known['poses']} poses, {known['intrinsics']} intrinsics{more}"))
        if known.keys() >= TIES:
            found.append(("known poses", ties(known)))
    if summary.get("loss"):
        found.append(("loss", f"{summary['loss']['first']:.4f} → {summary['loss']['last']:.4f}"))
    if summary.get("seconds"):
        found.append(("time", duration(sum(summary["seconds"].values()))))
    found.append(("licence of the weights", summary.get("licence_of_weights") or "not stated in this folder"))
    return found


def views(result: Result, photos: Sequence[PhotoLike] | None = None) -> Iterator[dict[str, Any]]:
    """One entry per photo, or for each of an even choice: name, title and pictures, each (class, caption, data URI)."""
    few = len(result.names) <= SOME_VIEWS
    width, side = (figures.MAX_WIDTH, PHOTO_SIDE) if few else (NARROW_WIDTH, PHOTO_SIDE_OF_MANY)
    depth_range, conf_range = map_ranges(result)
    read, numbers = result.full[result.final.key], sequence.view_numbers(result)
    for view in even_choice(len(numbers), MANY_VIEWS):
        photo = read.images[view] if photos is None else figures.photo_as_seen(photos[view].read(), read, view, side)
        pictures = [("photo", "photo", figures.data_uri(photo, side))]
        for kind, caption, image in _maps(result, view, depth_range, conf_range):
            pictures.append((kind, caption, figures.data_uri(image, width)))
        yield {"title": f"{numbers[view]}. {result.names[view]}", "name": result.names[view], "pictures": pictures}


def _maps(result: Result, view: int, depth_range: Range, conf_range: Range) -> Iterator[tuple[str, str, np.ndarray]]:
    """The colour-coded maps of a view: CSS classes, caption, image."""
    for stage in result.stages.values():
        depth = log_colours(result.view_depth(stage, view), depth_range, DEPTH_MAP)
        yield f"depth {stage.key}", f"depth, {stage.label}", depth
    if len(result.predictions) > 1:
        before, after = (result.view_depth(result.predictions[k], view) for k in (0, -1))
        yield "depth", "change of depth", change_map(before, after)
    for stage in result.predictions:
        error = result.view_error(stage, view)
        if error is not None:
            colours = figures.linear_colours(error, (0, ERROR_LIMIT), figures.ERROR_MAP)
            yield f"error {stage.key}", f"depth error, {stage.label}", colours
    for stage in result.predictions:
        conf = log_colours(result.full[stage.key].conf[view], conf_range, figures.CONF_MAP)
        yield f"confidence {stage.key}", f"confidence, {stage.label}", conf


def map_ranges(result: Result) -> tuple[Range, Range]:
    """Ranges of depth and confidence that all views and stages share."""
    depth = log_range(lambda: (stage.depth_z for stage in result.stages.values()))
    return depth, log_range(lambda: (stage.conf for stage in result.predictions))


def change_map(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Colours (H, W, 3) of the relative change of depth: red farther, blue nearer, white unchanged."""
    usable = np.isfinite(before) & np.isfinite(after) & (before > 0)
    change = np.divide(after, before, out=np.full(before.shape, np.nan, dtype=np.float32), where=usable) - 1
    return figures.linear_colours(change, (-CHANGE_LIMIT, CHANGE_LIMIT), figures.CHANGE_MAP)


def legends(result: Result) -> list[dict[str, str]]:
    """Colour scales: name, ends and gradient."""
    depth_range, conf_range = map_ranges(result)
    found = [_legend("depth", f"{depth_range[0]:.3g}", f"{depth_range[1]:.3g}", DEPTH_MAP)]
    found.append(_legend("confidence", f"{conf_range[0]:.3g}", f"{conf_range[1]:.3g}", figures.CONF_MAP))
    if len(result.predictions) > 1:
        limit = _percent(CHANGE_LIMIT, 0)
        found.append(_legend("change", f"{limit} nearer", f"{limit} farther", figures.CHANGE_MAP))
    if result.truth is not None:
        found.append(_legend("error", "0", f"{_percent(ERROR_LIMIT, 0)} or more", figures.ERROR_MAP))
    return found


def _legend(name: str, low: str, high: str, colours: str) -> dict[str, str]:
    return {
        "name": name,
        "map": "depth" if name == "change" else name,
        "low": low,
        "high": high,
        "gradient": figures.gradient(colours),
    }


def camera_rows(result: Result) -> list[tuple[str, str, str]]:
    """How far the cameras of two stages lie apart: what, median angle, median distance."""
    if not result.has_cameras:
        return []
    pairs = [(s, result.truth, f"{s.label}, from ground truth") for s in result.predictions if result.truth]
    if not pairs:
        first, *others = result.predictions
        pairs = [(stage, first, f"{stage.label}, from {first.label}") for stage in others]
    rows = []
    for stage, reference, name in pairs:
        assert reference is not None
        angle, distance = camera_difference(stage, reference)
        rows.append((name, f"{np.median(angle):.2f}°", f"{np.median(distance):.3g}"))
    return rows


def truth_rows(result: Result) -> list[tuple[str, str, str]]:
    """Depth against ground truth per model: name, mean relative error, share within 25 %."""
    rows = []
    for stage in result.predictions:
        if stage.error is None or result.truth is None or not np.isfinite(stage.error).any():
            continue
        valid = np.isfinite(stage.error)
        ratio = stage.depth_z[valid] / result.truth.depth_z[valid]
        inside = np.maximum(ratio, 1 / ratio) < 1.25
        rows.append((stage.label, f"{stage.error[valid].mean():.3f}", _percent(inside.mean())))
    return rows


def score_table(scores: Mapping[str, Any]) -> dict[str, Any] | None:
    """The scores that `freegeo demo` stored, as header and rows; None when there are none."""
    try:
        counts = list(next(iter(scores.values())))
        keys = [key for key in SCORE_LABELS if key in scores["frozen"][counts[0]]]
        rows = [
            (count, LABELS[stage], *(f"{scores[stage][count][key]:.3f}" for key in keys))
            for count in counts
            for stage in ("frozen", "adapted")
        ]
    except (StopIteration, KeyError, IndexError, TypeError, AttributeError):
        return None
    return {"header": ("views", "model", *(SCORE_LABELS[key] for key in keys)), "rows": rows}


def filter_tables(result: Result) -> list[dict[str, Any]]:
    """Pixels that the filters removed, per model."""
    return [_filter_table(stage.label, stage.removed, result.pixels) for stage in result.predictions if stage.removed]


def _filter_table(label: str, removed: Mapping[str, int], pixels: int) -> dict[str, Any]:
    rows = [(FILTER_TEXTS.get(name, name), f"{count:,}", _percent(count / pixels)) for name, count in removed.items()]
    kept = pixels - sum(removed.values())
    return {"label": label, "rows": rows, "kept": (f"{kept:,}", _percent(kept / pixels))}


def flattened(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Nested settings as (dotted name, text); lists are joined, long ones counted."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flattened(value, f"{prefix}{name}.")
        elif isinstance(value, list) and len(value) > 8:
            yield f"{prefix}{name}", f"{len(value)} entries"
        elif isinstance(value, list):
            yield f"{prefix}{name}", ", ".join(str(item) for item in value)
        else:
            yield f"{prefix}{name}", "–" if value is None else str(value)


def _percent(share: float, digits: int = 1) -> str:
    return f"{100 * float(share):.{digits}f} %"
