"""Did it help? The answer that summary, report and viewer begin with, from the content of ``reconstruction.json``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from freegeo.export.reconstruction import METRIC_MODEL

Outcome = Literal["yes", "no", "unknown"]

HEADER = ("model", "epipolar error, px", "reprojection error, px", "contradicted pixels, %", "matches", "sure, %")
NOTE = (
    "Medians over pairs of photos, from matches that no model has a part in: how far matching points lie from their "
    "epipolar lines (cameras), and from where depth and cameras put them, in pixels of the photos as they were "
    "matched; and the share of pixels whose depth other views contradict (in brackets: the frozen model's on the same "
    "pixels, which are not the same for every row). Smaller is better. Sure: how certain it is, by drawing pairs anew, "
    "that the matches fit better than before. For refined cameras the epipolar error is that of pairs that had no part "
    "in the adjustment."
)
OVERLAP = (
    "Take photos that share more: neighbours that overlap by two thirds, from different places instead of turns on the "
    "spot, in more light."
)
LACKING = {
    "matches": OVERLAP,
    "fit": "Try another --model (freegeo models), or leave out photos of moving and of repeated things: matches and "
    "prediction are too far apart to be brought together.",
    "proof": "Take photos between those that there are: more pairs can prove more.",
}
TIES = frozenset({"given", "odd", "chunks", "untied"})
"""What the record of known cameras says beside the rest where `ties` has something to tell."""
WORSE = 0.01
"""Growth of the share of contradicted pixels that a sentence about refinement mentions."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """The answer about one thing that was done."""

    what: str
    """`Adaptation` or `Refinement`."""
    outcome: Outcome
    sentence: str


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The answer, the scores that it rests on, and what to try where it is not yes."""

    parts: tuple[Part, ...]
    rows: tuple[tuple[str, ...], ...]
    """Cells by `HEADER`; the name of the row of the result ends in "(used)". Empty without scores."""
    advice: tuple[str, ...]


def answer(summary: Mapping[str, Any]) -> Answer | None:
    """Return the answer for a result; None where nothing was done that could help: neither adapted nor refined."""
    parts = [*_adaptation(summary), *_refinement(summary)]
    if not parts:
        return None
    return Answer(parts=tuple(parts), rows=tuple(_rows(summary)), advice=tuple(_advice(summary, parts)))


def rescaled(summary: Mapping[str, Any]) -> float | None:
    """Return the factor by which `--scale` changed known positions; None where they are in the result as given."""
    known, scale = summary.get("known_cameras"), summary.get("scale")
    if not known or not known["poses"] or not scale:
        return None
    own = METRIC_MODEL, f"the known cameras in {known['source']}"
    return None if scale["source"] in own else float(scale["value"])


def ties(known: Mapping[str, Any]) -> str:
    """Return what the known poses of some photos made of a piece of a sequence, for people."""
    untied = f"{known['untied']} of {known['chunks']} chunks without one"
    said = f"{known['given']} given, {len(known['odd'])} of them not used, {untied}"
    if known.get("rotation_deg") is None:
        return f"{said}; the piece is not in their world"
    far = "" if known.get("position") is None else f" and {100 * known['position']:.2g} % of the longest distance"
    angle = f"{known['rotation_deg']:.2g} degrees"
    return f"{said}; placed by them, the model's cameras differ from them by {angle}{far} in the median"


def _adaptation(summary: Mapping[str, Any]) -> Iterator[Part]:
    if not summary.get("recipe"):
        return
    verdict, rejected = summary.get("verdict"), summary.get("rejected_adapter")
    if rejected and rejected != (verdict or {}).get("reason"):
        yield Part(what="Adaptation", outcome="no", sentence=f"{rejected[0].upper()}{rejected[1:]}")
    elif verdict:
        outcomes: dict[str, Outcome] = {"adapted": "yes", "frozen": "no"}
        known = " These are the cameras that the model sees; the result has the known ones."
        sentence = verdict["reason"] + (known if summary.get("known_cameras") else "")
        yield Part(what="Adaptation", outcome=outcomes.get(verdict["outcome"], "unknown"), sentence=sentence)
    else:
        why = "the model predicts no cameras" if summary.get("filters") is None else "--guard off"
        yield Part(
            what="Adaptation", outcome="unknown", sentence=f"The matches between the photos were not asked ({why})."
        )


def _refinement(summary: Mapping[str, Any]) -> Iterator[Part]:
    told = summary.get("refinement")
    if told:
        more = " The cameras stay as they were predicted."
        if told["accepted"]:
            more, (before, after) = "", (_excess(told.get(key) or {}) for key in ("before", "after"))
            if before is not None and after is not None and after > before + WORSE:
                own, frozen = (1 - told["after"][key] for key in ("depth_agreement", "depth_agreement_frozen"))
                shares = f"{100 * own:.0f} % of the pixels (frozen: {100 * frozen:.0f} % of the same ones)"
                more = f" But depth maps contradict each other more, in {shares}: they are less exact than the cameras."
        outcome: Outcome = "yes" if told["accepted"] else "no"
        yield Part(what="Refinement", outcome=outcome, sentence=told["reason"] + more)


def _excess(scores: Mapping[str, float | None]) -> float | None:
    """Share of the pixels by which a prediction contradicts itself more than the frozen one; None where not known."""
    own, frozen = (scores.get(key) for key in ("depth_agreement", "depth_agreement_frozen"))
    return None if own is None or frozen is None else frozen - own


def _rows(summary: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Frozen, adapted as it was trained, adapted as it was chosen, refined: those that were measured."""
    verdict, told = summary.get("verdict") or {}, summary.get("refinement") or {}
    trials, chosen = verdict.get("trials") or [], verdict.get("chosen")
    is_adapted, refined = bool(summary.get("adapter")), bool(told.get("accepted"))
    frozen = verdict.get("frozen") or told.get("frozen") or (None if is_adapted else told.get("before"))
    as_trained = verdict.get("used") == "adapter"
    adapted: list[tuple[str, Mapping[str, Any], bool]] = []
    for number, trial in enumerate(trials):
        whole = trial["steps"] == trial["strength"] == 1
        if whole or number == chosen:
            state = "" if whole else f", strength {trial['strength']:g}, {100 * trial['steps']:g} % of steps"
            used = whole if as_trained else number == chosen
            adapted.append((f"adapted{state}", trial, is_adapted and used))
    if is_adapted and not adapted and told.get("before"):
        adapted = [("adapted", told["before"], True)]
    rows = [("frozen", frozen, not is_adapted), *adapted]
    rows = [(name, scores, used and not refined) for name, scores, used in rows]
    if told.get("after"):
        surely = {"probability": told.get("probability")}
        rows.append(("refined" if refined else "refined, refused", {**told["after"], **surely}, refined))
    for name, scores, used in rows:
        if scores and scores.get("epipolar_px") is not None:
            yield f"{name} (used)" if used else name, *_cells(scores)


def _cells(scores: Mapping[str, float | None]) -> tuple[str, ...]:
    shares = (scores.get(key) for key in ("depth_agreement", "depth_agreement_frozen"))
    own, frozen = (None if share is None else f"{100 * (1 - share):.1f}" for share in shares)
    probability = scores.get("probability")
    values = {
        **scores, "contradicted": own if frozen in (None, own) else f"{own} (frozen: {frozen})",
        "probability": None if probability is None else 100 * probability,
    }  # fmt: skip
    formats = (
        ("epipolar_px", "{:.2f}"), ("reprojection_px", "{:.2f}"), ("contradicted", "{}"), ("matches", "{:,}"),
        ("probability", "{:.0f}"),
    )  # fmt: skip
    return tuple("–" if values.get(name) is None else text.format(values[name]) for name, text in formats)


def _advice(summary: Mapping[str, Any], parts: list[Part]) -> Iterator[str]:
    """What to try next, where something did not help."""
    outcomes = {part.what: part.outcome for part in parts}
    adaptation, verdict = outcomes.get("Adaptation"), summary.get("verdict")
    lacking = (summary.get("refinement") or {}).get("lacking")
    if adaptation == "unknown" and verdict and lacking != "matches":
        yield OVERLAP
    if lacking:
        yield LACKING[lacking]
    if adaptation == "unknown" and not verdict and summary.get("filters") is not None:
        yield "--guard select: let the matches decide whether the adapter is used."
    could_refine = summary.get("filters") is not None and not summary.get("known_cameras")
    if adaptation == "no" and "Refinement" not in outcomes and could_refine:
        yield "--refine ba: bring the cameras to the matches by bundle adjustment (pip install 'freegeo[colmap]')."
    if adaptation == "no" and verdict:
        recipe = summary["recipe"]
        steps = f" (now {recipe['steps']})" if recipe.get("steps") else ""
        yield f"Fewer --steps{steps} or a lower --lr (now {recipe['lr']:g}): a smaller change does less harm."
        if recipe["hold"] < 1:
            yield f"--hold 1 (now {recipe['hold']:g}): keep the answer from all photos where it was."
