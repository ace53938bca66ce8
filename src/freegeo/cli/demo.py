"""`freegeo demo`: a generated room, photographed, reconstructed, adapted to, reconstructed again, and scored."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from freegeo.cli import console
from freegeo.cli.jobs import run_job
from freegeo.cli.options import DemoModelOptions, OutputOptions, RecipeOptions
from freegeo.cli.sources import DEMO_DOMAIN, demo_scene
from freegeo.errors import DamagedError
from freegeo.export.photos import write_copies
from freegeo.files import read_json, write_json

if TYPE_CHECKING:
    from freegeo.data.scene import Scene
    from freegeo.export.reconstruction import Reconstruction
    from freegeo.job import Job

SCORES_NAME = "scores.json"
DEFAULT_RECIPE, DEFAULT_MODEL = RecipeOptions(), DemoModelOptions()
EVERY = 8
VIEWS = (4, 8)
WINDOW_STEP = 2
"""Scores are means over windows of eight neighbouring frames; "4 views" are every second frame of each."""


def demo(
    *,
    output: Annotated[Path, Parameter(name=("--output", "-o"))] = Path("out/demo"),
    overwrite: bool = False,
    room: int = 0,
    domain: str = DEMO_DOMAIN,
    model: DemoModelOptions = DEFAULT_MODEL,
    recipe: RecipeOptions = DEFAULT_RECIPE,
) -> None:
    """Show the whole line on a generated room, against exact ground truth. Works offline on a CPU.

    Parameters
    ----------
    output
        Folder for the results.
    overwrite
        Replace what an earlier run with other options wrote there.
    room
        Number of the room.
    domain
        Kind of room: test-id (like training), light (dark, colour cast, noise), lowtex, tex, big,
        sparse (photos far apart).
    """
    scene = demo_scene(room, domain)
    extra = {"room": room, "domain": domain}
    target = OutputOptions(output=output, overwrite=overwrite)

    def add_scores(job: Job) -> None:
        write_copies(scene.photos, output / "photos")
        true_reconstruction(job, scene).save(output / "truth")
        write_json(output / SCORES_NAME, score_windows(job, scene))

    run_job(
        scene.photos, model, target, command="demo", recipe=recipe, guard="report", extra_settings=extra,
        after=add_scores,
    )  # fmt: skip
    report(read_scores(output / SCORES_NAME), domain)


def read_scores(path: Path) -> dict[str, Any]:
    """Read what `score_windows` gave an earlier command; DamagedError when a score is missing."""
    from freegeo.metrics.scene import PRINTED
    from freegeo.report.schema import DemoScores

    advice = "Run again with --overwrite."
    scores = read_json(path, DemoScores, advice=advice) if path.is_file() else {}
    for name in ("frozen", "adapted"):
        for views in map(str, VIEWS):
            for key in PRINTED:
                if key not in scores.get(name, {}).get(views, {}):
                    raise DamagedError(path, f"{key} of {name} with {views} views is missing", advice)
    return scores


def true_reconstruction(job: Job, scene: Scene) -> Reconstruction:
    """Return the ground truth at the model's size, for the report."""
    from freegeo.export.reconstruction import Reconstruction
    from freegeo.metrics.scene import at_size
    from freegeo.types import Prediction

    assert scene.depth_z is not None and scene.K is not None
    depth_z, K = at_size(scene.depth_z, scene.K, job.batch.image_hw)
    return Reconstruction.from_prediction(Prediction(depth_z=depth_z, T_cam_world=scene.T_cam_world, K=K), job.batch)


def score_windows(job: Job, scene: Scene) -> dict[str, Any]:
    """Score the frozen and the adapted model with 4 and 8 views, mean over windows."""
    scores: dict[str, Any] = {}
    assert job.in_place is not None
    with job.in_place.off():
        scores["frozen"] = {str(views): mean_score(job, scene, views) for views in VIEWS}
    scores["adapted"] = {str(views): mean_score(job, scene, views) for views in VIEWS}
    return scores


def mean_score(job: Job, scene: Scene, views: int) -> dict[str, float]:
    """Score the model with the adapter that is on, if any."""
    from freegeo.metrics.scene import evaluate
    from freegeo.pipeline import predict

    rows = []
    for frames in windows(len(scene), views):
        found = predict(job.model, job.batch.select(frames), reference="first", compute=job.compute)
        rows.append(evaluate(found, scene.select(frames)))
    return {key: sum(row[key] for row in rows) / len(rows) for key in rows[0]}


def windows(count: int, views: int) -> list[list[int]]:
    """Return the frames of every window: eight neighbours, or every second of them."""
    starts = range(0, count - EVERY + 1, WINDOW_STEP)
    return [list(range(start, start + EVERY, EVERY // views)) for start in starts]


def report(scores: dict[str, Any], domain: str) -> None:
    """Print the table of scores and a sentence on what adaptation changed."""
    from freegeo.metrics.scene import PRINTED

    header = ("views", "model", *(name.replace("auc0", "auc") for name in PRINTED))
    rows = [
        (views, name, *(f"{scores[name][views][key]:.3f}" for key in PRINTED))
        for views in ("4", "8")
        for name in ("frozen", "adapted")
    ]
    console.say(f"\nAgainst ground truth (room of domain '{domain}', means over windows of 8 neighbouring frames):")
    console.say(console.table(header, rows))
    console.say("auc and f1: higher is better; abs_rel: lower is better.")
    for views in ("4", "8"):
        console.say(f"{views} views: {verdict(scores['frozen'][views], scores['adapted'][views])}")
    console.say("One room is no evidence; the tables over many rooms are in docs/.")


def verdict(frozen: dict[str, float], adapted: dict[str, float]) -> str:
    """Say in one sentence what adaptation changed."""
    better = {
        "AUC@30": adapted["auc30"] - frozen["auc30"],
        "F1": adapted["f1_rel5"] - frozen["f1_rel5"],
        "abs-rel": frozen["abs_rel"] - adapted["abs_rel"],
    }
    helped = [name for name, gain in better.items() if gain > 0]
    hurt = [name for name, gain in better.items() if gain <= 0]
    if not helped:
        return "adaptation did not help on this room."
    return f"adaptation improved {and_join(helped)}" + (f", but not {and_join(hurt)}." if hurt else ".")


def and_join(names: Sequence[str]) -> str:
    """Join names for a sentence."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
