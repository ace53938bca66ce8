"""`freegeo bench`: the published evaluation and every table of the paper."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from freegeo.adaptation.recipe import PAPER_SEED, RecipeName
from freegeo.cli import console
from freegeo.cli.options import ModelOptions, RecipeOptions, use_few_threads
from freegeo.errors import FreeGeoError, UserError
from freegeo.host import gigabytes
from freegeo.models.catalog import EMBEDDED_MODEL
from freegeo.progress import progress_bar

if TYPE_CHECKING:
    import torch

    from freegeo.adaptation.recipe import Recipe
    from freegeo.benchmark.check import Finding
    from freegeo.benchmark.download import Offer
    from freegeo.benchmark.paper.experiments import Experiment
    from freegeo.benchmark.paper.reproduction import Reproduction
    from freegeo.benchmark.predict import Predictor
    from freegeo.benchmark.tasks import FrameRule, Problem, Task
    from freegeo.models.spec import AdaptationDefaults

app = App(
    name="bench", help="Published evaluation: datasets, tables, comparison with the paper.", help_format="plaintext"
)

DATA = Path("benchmark-data")
PROBLEMS_FILE = "problems.json"
TABLES = "tables"
SHOWN_PROBLEMS = 20
QUICK_SCENES, QUICK_SEEDS, QUICK_STEPS = 10, 1, 60
"""What --quick stands for: scenes of every dataset, how many of an experiment's seeds, optimiser steps."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """What a benchmark run is made of."""

    output: Annotated[Path, Parameter(name=("--output", "-o"))] = Path("out/bench")
    """Folder of predictions, adapters, results and tables."""
    data: Path = DATA
    """Folder of the unpacked datasets; generated rooms are rendered into it."""
    datasets: str = "procedural"
    """Separated by commas: eth3d, 7scenes, scannetpp, hiroom, procedural (the reported rooms), procedural-light, ..."""
    scenes: int | None = None
    """Only the first so many scenes of every dataset."""
    views: str | None = None
    """Only these numbers of views, such as 4,8."""
    seeds: str | None = None
    """Frame seeds instead of the experiment's, such as 43,44,45."""
    frames: Literal["da3", "vggt", "experiment", "neighbours"] | None = None
    """Frame rule, where the experiment has none of its own (docs/benchmark.md); default: the model family's."""
    quick: bool = False
    """10 scenes of every dataset, an experiment's first seed, 60 steps of adaptation, unless given otherwise."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BenchModel(ModelOptions):
    """Which model is scored."""

    model: str = EMBEDDED_MODEL
    """Name (`freegeo models`) or hub id of a model, or a plug-in's name."""
    seed: Annotated[int, Parameter(name="--adapt-seed")] = PAPER_SEED
    """Seed of the adaptation; the frames have seeds of their own (--seeds)."""
    reference: Annotated[None, Parameter(parse=False)] = None
    """Not an option here: the first view is always the reference."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BenchRecipe(RecipeOptions):
    """How the model is adapted; settings left out are those of the recipe for each dataset."""

    recipe: RecipeName = "paper"
    """Named settings; a dataset for which none were published takes those of generated rooms."""
    dataset: Annotated[None, Parameter(parse=False)] = None
    """Not an option here: every dataset has its own settings."""
    views: Annotated[int | None, Parameter(name="--teacher-views")] = None
    """Photos in one training example of the adaptation; --views are those that are scored. Default: 8."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PredictOptions:
    """How the first stage is carried out."""

    adapt_per: Literal["dataset", "scene"] = "dataset"
    """One adapter for all scenes of a dataset, or one for each."""
    epoch: int | None = None
    """Epoch whose adapter is used, counted from 0; default: the last."""
    process_res: int | None = None
    """Longest side of the model's images, in the adaptation (but for recipes that squash) and in predictions. The
    published tables are those of the default, 504."""
    given_cameras: bool = False
    """Give the model the true cameras and fuse its depth with them (recon_posed)."""
    overwrite: bool = False
    """Replace predictions that were made with other settings."""
    cluster: bool = False
    """Spread the tasks over a ray cluster (extra `cluster`)."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ReproduceOptions(BenchOptions):
    """What a reproduction of the paper is made of."""

    output: Annotated[Path, Parameter(name=("--output", "-o"))] = Path("out/reproduction")
    """Folder of predictions, adapters, results, tables and the page."""
    datasets: str = "eth3d,7scenes,scannetpp,hiroom"
    """The paper's datasets that are used, separated by commas; one that is not complete is left out."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ReproduceModel(BenchModel):
    """Which model is compared with the paper."""

    model: str = "da3-giant"
    """Name or hub id of a model of a family that the paper reports; the paper's are da3-giant and vggt-1b."""


BENCH, MODEL, RECIPE, PREDICT = BenchOptions(), BenchModel(), BenchRecipe(), PredictOptions()
REPRODUCE, REPRODUCE_MODEL = ReproduceOptions(), ReproduceModel()


@app.command(name="list")
def list_experiments() -> None:
    """List the experiments."""
    from freegeo.benchmark.paper.experiments import EXPERIMENTS

    rows = [(entry.name, entry.title) for entry in EXPERIMENTS.values()]
    width = max(len(name) for name, _ in rows)
    for name, title in rows:
        console.say(f"{name.ljust(width)}  {title}")


@app.command
def download(*names: str, data: Path = DATA, yes: bool = False) -> None:
    """Fetch datasets from the model hub, check and unpack them; what was downloaded already is kept.

    Parameters
    ----------
    names
        eth3d, 7scenes, scannetpp, hiroom.
    data
        Folder that gets the datasets.
    yes
        Accept the terms that are shown, and start without asking.
    """
    from freegeo.benchmark import download as archives
    from freegeo.benchmark.check import check_dataset
    from freegeo.benchmark.tasks import unique
    from freegeo.lock import locked

    if not names:
        raise UserError("name at least one dataset: eth3d, 7scenes, scannetpp, hiroom.")
    offers = [archives.offer(data, name) for name in unique(list(names))]
    for one in offers:
        console.say(f"{one.name}: {_offered(one)}\n  terms: {one.archive.terms}")
    waiting = [one for one in offers if one.state != "complete"]
    if not waiting:
        return
    missing = sum(one.size - one.kept for one in waiting)
    free = archives.require_room(data, waiting)
    console.say(
        f"source: {archives.PAGE}\nto download: {gigabytes(missing)}; free on the disk of {data}: "
        f"{gigabytes(free)}. The content is larger than the archives; it is measured before it is unpacked."
    )
    _require_yes(yes)
    with locked(data):
        for one in waiting:
            archives.fetch(one)
            with progress_bar(f"unpacking {one.name}, MB", 1 + one.size // 1_000_000) as update:
                archives.unpack(one, data, lambda done, total, update=update, one=one: update(
                    done * (1 + one.size // 1_000_000) // max(1, total)
                ))  # fmt: skip
            console.say(f"{one.name}: unpacked; {one.path} ({gigabytes(one.size)}) is not needed any more")
            _require([check_dataset(data, one.name)], data, "usable", "not to be used")


def _offered(one: Offer) -> str:
    if one.state == "complete":
        return "complete, nothing to do"
    if one.state == "archive":
        return f"{one.path} ({gigabytes(one.size)}) is there and will be unpacked"
    kept = f", {gigabytes(one.kept)} of them downloaded already" if one.kept else ""
    return f"{one.path.name}, {gigabytes(one.size)}{kept}"


def _require_yes(yes: bool) -> None:
    """Return when the user agrees; UserError when there is nobody to ask, or when the answer is no."""
    import sys

    if yes:
        return
    if not sys.stdin.isatty():
        raise UserError("there is no terminal to ask in. Read the terms above, and pass --yes to accept them.")
    console.say("Accept these terms and start? [y/N]")
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UserError("nothing was downloaded.")


@app.command
def check(data: Path = DATA, *, datasets: str | None = None) -> None:
    """Say what is missing in a data folder and how to get it.

    Parameters
    ----------
    data
        Folder of the unpacked datasets.
    datasets
        Datasets to look at, separated by commas; default: all that are not generated.
    """
    from freegeo.benchmark.check import check_data

    findings = check_data(data, None if datasets is None else _split(datasets))
    _require(findings, data, "complete", "incomplete")


def _require(findings: Sequence[Finding], data: Path, property: Literal["complete", "usable"], otherwise: str) -> None:
    """Say what each dataset lacks; FreeGeoError when one does not have a property."""
    for finding in findings:
        console.say(f"{finding.dataset}: {finding.scenes} of {finding.wanted or '?'} scenes complete")
        for problem in finding.problems[:SHOWN_PROBLEMS]:
            console.say(f"  {problem}")
        if len(finding.problems) > SHOWN_PROBLEMS:
            console.say(f"  and {len(finding.problems) - SHOWN_PROBLEMS} more")
        if not finding.complete:
            console.say(f"  get it: {finding.how_to_get}")
    if wrong := [finding.dataset for finding in findings if not getattr(finding, property)]:
        raise FreeGeoError(f"{data}: {otherwise} for {', '.join(wrong)}; the lines above say what is missing.")


@app.command
def predict(
    *experiments: str,
    bench: BenchOptions = BENCH,
    model: BenchModel = MODEL,
    recipe: BenchRecipe = RECIPE,
    options: PredictOptions = PREDICT,
    estimate_only: bool = False,
) -> None:
    """First stage: predict everything the experiments need; a stopped run continues.

    Parameters
    ----------
    experiments
        Names (`freegeo bench list`), or all.
    estimate_only
        Only say what it would cost.
    """
    predictor, tasks = _prepare(experiments, bench, model, recipe, options)
    problems = _predict(predictor, tasks, bench, estimate_only=estimate_only, cluster=options.cluster)
    _say(problems)
    _require_none(problems, bench.output)


@app.command
def evaluate(*experiments: str, bench: BenchOptions = BENCH, device: str | None = None, figures: bool = False) -> None:
    """Second stage: score the stored predictions of a folder and print the tables; needs no model.

    Parameters
    ----------
    experiments
        Names whose tables are printed; none: all that have results.
    device
        Where depth is fused.
    figures
        Draw the figures too.
    """
    problems = _evaluate(bench, device, wanted=None)
    _say(problems)
    _tables(experiments or ("all",), bench)
    if figures:
        _figures(bench)
    _require_none(problems, bench.output)


@app.command
def run(
    *experiments: str,
    bench: BenchOptions = BENCH,
    model: BenchModel = MODEL,
    recipe: BenchRecipe = RECIPE,
    options: PredictOptions = PREDICT,
    figures: bool = False,
) -> None:
    """Both stages: predict, evaluate, print the tables.

    Parameters
    ----------
    experiments
        Names (`freegeo bench list`), or all.
    figures
        Draw the figures too.
    """
    predictor, tasks = _prepare(experiments, bench, model, recipe, options)
    problems, scored = _both_stages(predictor, tasks, bench, model, options)
    if scored:
        _tables(experiments, bench)
    if scored and figures:
        _figures(bench)
    _require_none(problems, bench.output)


@app.command
def reproduce(
    *,
    tables: str | None = None,
    bench: ReproduceOptions = REPRODUCE,
    model: ReproduceModel = REPRODUCE_MODEL,
    recipe: BenchRecipe = RECIPE,
    options: PredictOptions = PREDICT,
    estimate_only: bool = False,
) -> None:
    """Run every table of the paper that the model and the data allow, and write ours beside the paper's.

    Parameters
    ----------
    tables
        Only these, separated by commas (`freegeo bench list`).
    estimate_only
        Only say what would be run and what it would cost.
    """
    from dataclasses import replace

    from freegeo.benchmark.check import check_data
    from freegeo.benchmark.paper.experiments import EXPERIMENTS
    from freegeo.benchmark.paper.reproduction import PAPER_DATASETS, PAPER_TABLES, left_out
    from freegeo.benchmark.tasks import unique

    if options.given_cameras:
        raise UserError("no table of the paper was made with given cameras; leave --given-cameras out.")
    names = PAPER_TABLES if tables is None else unique(_split(tables))
    if unknown := [name for name in names if name not in PAPER_TABLES]:
        raise UserError(f"--tables {unknown[0]}: the paper's tables are {', '.join(PAPER_TABLES)}.")
    datasets = unique(_split(bench.datasets))
    if unknown := [name for name in datasets if name not in PAPER_DATASETS]:
        raise UserError(f"--datasets {unknown[0]}: the paper's are {', '.join(PAPER_DATASETS)}.")
    family = _adaptation(model.name).published
    if family is None:
        raise UserError(f"the paper reports no model like {model.name}; choose da3-giant or vggt-1b.")
    findings = check_data(bench.data, datasets)
    incomplete = {finding.dataset: finding.blocking[0] for finding in findings if finding.blocking}
    complete = [name for name in datasets if name not in incomplete]
    if not complete:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in incomplete.items())
        raise UserError(
            f"no dataset of the paper is complete in {bench.data} ({reasons}). `freegeo bench download` fetches them."
        )
    reasons = {name: left_out(EXPERIMENTS[name], family, incomplete, complete) for name in names}
    running = [name for name, reason in reasons.items() if reason is None]
    console.say(f"{len(running)} of {len(names)} tables: {', '.join(running) or 'none'}")
    not_run = tuple((name, EXPERIMENTS[name].title, reason) for name, reason in reasons.items() if reason is not None)
    for name, _, reason in not_run:
        console.say(f"  not {name}: {reason}")
    for name, reason in incomplete.items():
        console.say(f"  without {name}: {reason}")
    if not running:
        raise UserError("none of these tables can be run; the lines above say why.")
    chosen_bench = replace(bench, datasets=",".join(complete))
    predictor, tasks = _prepare(running, chosen_bench, model, recipe, options)
    if estimate_only:
        _predict(predictor, tasks, chosen_bench, estimate_only=True)
        return
    problems, scored = _both_stages(predictor, tasks, chosen_bench, model, options)
    if scored:
        _tables(running, chosen_bench, shown=False)
        page = _reproduction(running, predictor, chosen_bench, model, recipe, problems)
        _write_page(
            replace(
                page,
                not_run=not_run,
                doubts=(
                    *page.doubts,
                    *(f"Without {name}: {reason}." for name, reason in incomplete.items()),
                    *(f"{f.dataset}: {problem}." for f in findings if f.usable for problem in f.problems),
                ),
            ),
            bench.output,
        )
    _require_none(problems, bench.output)


def _reproduction(
    names: Sequence[str],
    predictor: Predictor,
    bench: BenchOptions,
    model: BenchModel,
    recipe: BenchRecipe,
    problems: Sequence[Problem],
) -> Reproduction:
    """Compare the results of a run with the paper's tables, and gather what they were made with."""
    from datetime import UTC, datetime

    from freegeo.benchmark.paper.experiments import experiment
    from freegeo.benchmark.paper.published import PAPER_MODELS
    from freegeo.benchmark.paper.reproduction import Reproduction, compared_table
    from freegeo.benchmark.results import read_results
    from freegeo.data.datasets.registry import scene_names
    from freegeo.job import versions

    family, rule = predictor.model.spec.adaptation.published or "", _rule(bench, model.name)
    rows = read_results(bench.output)
    datasets = _split(bench.datasets)
    scenes = {dataset: scene_names(bench.data, dataset) for dataset in datasets}
    recipes = {dataset: _flat(predictor.recipe(dataset)) for dataset in datasets}
    doubts = []
    name = predictor.model.spec.name
    if name != PAPER_MODELS[family]:
        doubts.append(
            f"The paper's numbers are of {PAPER_MODELS[family]}, these of {name}: both things differ at once."
        )
    if bench.quick:
        doubts.append(
            f"A quick trial: at most {QUICK_SCENES} scenes of a dataset, one seed, {QUICK_STEPS} steps of adaptation. "
            "Nothing is marked."
        )
    if changed := {setting: value for setting, value in recipe.changes().items() if value not in (None, {})}:
        settings = ", ".join(f"{setting} = {value}" for setting, value in changed.items())
        doubts.append(f"The adaptation was changed by hand ({settings}), so adapted rows are not the paper's.")
    if bench.frames is not None:
        doubts.append(f"The frames were chosen by the rule {bench.frames} on request.")
    if problems:
        doubts.append(f"{len(problems)} parts failed and are listed below; means that lack them are not marked.")
    loaded, compute = predictor.model.loaded_from, predictor.compute
    facts = (
        ("model", name),
        ("weights", f"{loaded.file}, fingerprint {loaded.fingerprint}" if loaded else "unknown"),
        ("recipe", f"{recipe.recipe}, one adapter per {predictor.setup.adapt_per}, seed {model.seed}"),
        ("datasets", ", ".join(f"{dataset} (scenes: {len(own)})" for dataset, own in scenes.items())),
        ("device", f"{_device(compute.device)}, predictions in {compute.precision}"),
        ("versions", ", ".join(f"{package} {version}" for package, version in versions().items())),
        ("finished", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")),
        ("command", console.command_line()),
    )
    return Reproduction(
        facts=facts,
        doubts=(*doubts, *console.warned()),
        tables=tuple(
            compared_table(experiment(table), rows, scenes, rule=rule, family=family, judged=not bench.quick)
            for table in names
        ),
        not_run=(),
        problems=tuple(str(problem) for problem in problems),
        datasets=tuple(datasets),
        settings=tuple(
            (setting, tuple(recipes[dataset][setting] for dataset in datasets)) for setting in recipes[datasets[0]]
        ),
    )


def _device(device: torch.device) -> str:
    """The name of a device, of a GPU by its maker."""
    import torch

    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type.upper()


def _flat(recipe: Recipe) -> dict[str, str]:
    """The settings of a recipe as text, those of the loss beside the others."""
    from dataclasses import asdict

    settings = asdict(recipe)
    loss = settings.pop("loss")
    return {name: str(value) for name, value in (settings | {f"loss.{k}": v for k, v in loss.items()}).items()}


def _write_page(page: Reproduction, out: Path) -> None:
    from freegeo.files import atomic_path
    from freegeo.report.reproduction import render

    for name, text in (("reproduction.html", render(page)), ("reproduction.md", page.as_markdown())):
        with atomic_path(out / name) as part:
            part.write_text(text, encoding="utf-8")
        console.say(str(out / name))
    console.say(page.answer)


def _both_stages(
    predictor: Predictor, tasks: list[Task], bench: BenchOptions, model: BenchModel, options: PredictOptions
) -> tuple[list[Problem], bool]:
    """Predict and score; returns what failed, and whether there is anything that was scored."""
    from freegeo.benchmark.tasks import stored_tasks

    problems = _predict(predictor, tasks, bench, cluster=options.cluster)
    # Failed predictions are reported already, so only stored tasks are evaluated.
    stored = {task for task, _ in stored_tasks(bench.output)}
    wanted = [task for task in tasks if task in stored]
    if wanted:
        problems += _evaluate(bench, model.device, wanted=wanted)
    _say(problems)
    return problems, bool(wanted)


def _prepare(
    experiments: Sequence[str], bench: BenchOptions, model: BenchModel, recipe: BenchRecipe, options: PredictOptions
) -> tuple[Predictor, list[Task]]:
    """Return the predictor and the tasks of a run."""
    from freegeo.benchmark.paper.experiments import chosen, datasets_of
    from freegeo.benchmark.predict import Predictor, Setup, listed_scenes
    from freegeo.benchmark.tasks import unique

    if not experiments:
        raise UserError("name at least one experiment, or all; `freegeo bench list` lists them.")
    entries = chosen(experiments)
    names = _datasets(bench.datasets)
    limit = bench.scenes or (QUICK_SCENES if bench.quick else None)
    seeds = _numbers(bench.seeds, "--seeds")
    scenes = {name: listed_scenes(bench.data, name, limit) for name in names}
    rule = _rule(bench, model.name)
    tasks = [
        task
        for entry in entries
        for task in entry.tasks(
            {name: scenes[name] for name in datasets_of(entry, names)}, rule=rule,
            seeds=seeds or (entry.frame_seeds(rule)[:QUICK_SEEDS] if bench.quick else None),
            views=_numbers(bench.views, "--views"),
        )
    ]  # fmt: skip
    changes = recipe.changes()
    if bench.quick and recipe.steps is None and recipe.epochs is None:
        changes["steps"] = QUICK_STEPS
    predictor = Predictor(
        Setup(
            data=bench.data, out=bench.output, model=model.name, checkpoint=model.checkpoint, device=model.device,
            precision=model.precision, recipe=recipe.recipe, changes=changes, adapt_per=options.adapt_per,
            adapt_seed=model.seed, epoch=options.epoch, given_cameras=options.given_cameras, scenes=scenes,
            process_res=options.process_res, overwrite=options.overwrite,
        )
    )  # fmt: skip
    use_few_threads(predictor.model)
    _say_unpublished(names, recipe.recipe)
    return predictor, unique(tasks)


def _say_unpublished(names: Sequence[str], recipe: str) -> None:
    """Say which datasets have no settings of their own in a recipe that has one row per dataset."""
    from freegeo.data.datasets.registry import get_dataset

    without = [name for name in names if get_dataset(name).recipe_row is None]
    if without and recipe != "scene":
        console.note(
            f"recipe '{recipe}' has no settings for {', '.join(without)}; those of generated rooms are used "
            '(docs/benchmark.md, "Adding a dataset").'
        )


def _predict(
    predictor: Predictor, tasks: list[Task], bench: BenchOptions, *, estimate_only: bool = False, cluster: bool = False
) -> list[Problem]:
    from freegeo.benchmark.cost import estimate, estimate_scoring
    from freegeo.benchmark.predict import predict_all

    waiting = predictor.unfinished(tasks)
    console.say(f"{len(tasks)} tasks, {len(tasks) - len(waiting)} of them finished")
    if not waiting:
        with _writing(bench.output):
            return []
    predicting = estimate(predictor, waiting)
    for line in predicting.lines():
        console.say(f"  {line}")
    scoring = estimate_scoring(bench.data, waiting, device=predictor.compute.device)
    for cost in scoring:
        console.say(f"  {cost.line()}")
    hours = (predicting.seconds + sum(cost.seconds for cost in scoring)) / 3600
    console.say(
        f"  in all about {hours:.1f} hours on {_device(predictor.compute.device)}, by one pass of each size, a few "
        "steps and one small fusion that were measured just now; reading photos is not in it"
    )
    if estimate_only:
        return []
    with _writing(bench.output), progress_bar("predicting", len(waiting)) as update:
        done = 0

        def on_task(task: Task) -> None:
            nonlocal done
            done += 1
            update(done, str(task))

        def on_step(job, progress) -> None:
            if progress.step % 10 == 0 or progress.step + 1 == progress.steps:
                update(done, f"adapting to {job.dataset}, step {progress.step + 1} of {progress.steps}")

        if cluster:
            from freegeo.benchmark.cluster import predict_on_cluster

            return predict_on_cluster(predictor, tasks, on_task=on_task)
        return predict_all(predictor, tasks, on_step=on_step, on_task=on_task)


@contextmanager
def _writing(folder: Path) -> Generator[None]:
    """Lock a folder of predictions, and remove what a process that was killed left half-written there."""
    from freegeo.files import keep_ledger, remove_parts
    from freegeo.lock import locked

    with locked(folder):
        keep_ledger(folder)
        remove_parts(folder)
        yield


def _evaluate(bench: BenchOptions, device: str | None, *, wanted: list[Task] | None) -> list[Problem]:
    from freegeo.benchmark.score import evaluate_all
    from freegeo.benchmark.tasks import stored_tasks
    from freegeo.models.precision import choose_device

    total = len(wanted) if wanted is not None else len(stored_tasks(bench.output))
    if not bench.output.is_dir():
        raise UserError(f"{bench.output}: holds no predictions. Run `freegeo bench predict` first.")
    with _writing(bench.output), progress_bar("scoring", max(total, 1)) as update:
        done = 0

        def on_task(task: Task) -> None:
            nonlocal done
            done += 1
            update(done, str(task))

        result = evaluate_all(bench.data, bench.output, wanted=wanted, device=choose_device(device), on_task=on_task)
    console.say(f"{len(result.rows)} numbers: " + ", ".join(str(path) for path in result.files))
    return result.problems


def _tables(experiments: Sequence[str], bench: BenchOptions, *, shown: bool = True) -> None:
    """Write the tables in every format, and print them as text where they are to be `shown`."""
    from freegeo.benchmark.paper.experiments import chosen
    from freegeo.benchmark.paper.tables import TABLE_WRITERS, as_text, experiment_tables
    from freegeo.benchmark.results import read_results
    from freegeo.files import atomic_path

    rows = read_results(bench.output)
    family = _adaptation(rows[0].model).published if rows else None
    rule = _rule(bench, rows[0].model) if rows else "da3"
    for entry in chosen(experiments):
        tables = experiment_tables(entry, rows, rule=rule, family=family)
        if not _has_own(entry, tables):
            continue
        for table in tables if shown else ():
            console.say(f"\n{as_text(table)}")
        for ending, layout in TABLE_WRITERS.items():
            with atomic_path(bench.output / TABLES / f"{entry.name}.{ending}") as part:
                part.write_text("\n".join(layout(table) for table in tables), encoding="utf-8")
    console.say(f"tables: {bench.output / TABLES}")


def _has_own(entry: Experiment, tables: Sequence) -> bool:
    return any("published" not in table.title for table in tables)


def _adaptation(model: str) -> AdaptationDefaults:
    from freegeo.models.catalog import build_empty

    spec = build_empty(model).spec
    if not spec.cameras:
        raise UserError(f"{spec.name} predicts no cameras, which the benchmark scores. Choose another model.")
    return spec.adaptation


def _rule(bench: BenchOptions, model: str) -> FrameRule:
    """Return the frame rule of a run: the one asked for, or that of the model's family."""
    from freegeo.benchmark.tasks import family_rule

    own = family_rule(_adaptation(model))
    return bench.frames or own


def _figures(bench: BenchOptions) -> None:
    from freegeo.benchmark.paper.figures import draw_all

    for path in draw_all(bench.data, bench.output):
        console.say(str(path))


def _say(problems: Sequence[Problem]) -> None:
    """List what failed, before anything else can."""
    for problem in problems[:SHOWN_PROBLEMS]:
        console.note(str(problem))
    if len(problems) > SHOWN_PROBLEMS:
        console.note(f"and {len(problems) - SHOWN_PROBLEMS} more")


def _require_none(problems: Sequence[Problem], out: Path) -> None:
    """Store what failed and end with exit code 1 when anything did."""
    from dataclasses import asdict

    from freegeo.files import remove_file, write_json

    if not problems:
        remove_file(out / PROBLEMS_FILE)
        return
    write_json(out / PROBLEMS_FILE, [asdict(problem) for problem in problems])
    scenes = {(problem.dataset, problem.scene) for problem in problems}
    raise FreeGeoError(
        f"{len(problems)} parts of {len(scenes)} scenes could not be computed, the others were. "
        f"{out / PROBLEMS_FILE} lists them."
    )


def _datasets(text: str) -> list[str]:
    from freegeo.benchmark.paper.experiments import ROOMS
    from freegeo.benchmark.tasks import unique
    from freegeo.data.datasets.registry import DATASETS

    names = unique([name for part in _split(text) for name in (ROOMS if part == "procedural" else (part,))])
    unknown = [name for name in names if name not in DATASETS]
    if unknown:
        raise UserError(f"--datasets {unknown[0]}: known are procedural, {', '.join(DATASETS)}.")
    return names


def _split(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _numbers(text: str | None, option: str) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(part) for part in _split(text)]
    except ValueError:
        raise UserError(f"{option} '{text}' is no list of numbers. Write it as 4,8.") from None
