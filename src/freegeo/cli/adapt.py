"""`freegeo adapt`: train an adapter on one or several scenes and save it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from freegeo.adaptation.recipe import Guard
from freegeo.cli import console
from freegeo.cli.jobs import say_finished
from freegeo.cli.options import CameraOptions, ModelOptions, OutputOptions, PhotoOptions, RecipeOptions
from freegeo.cli.sources import load_source, split_scenes
from freegeo.progress import step_bar

if TYPE_CHECKING:
    from freegeo.adaptation.recipe import Recipe
    from freegeo.adaptation.samples import SceneImages
    from freegeo.models.api import ReconstructionModel
    from freegeo.types import ImageBatch, PhotoLike

DEFAULT_RECIPE, DEFAULT_MODEL, DEFAULT_PHOTOS = RecipeOptions(), ModelOptions(), PhotoOptions()
NO_CAMERAS = CameraOptions()
FILES = {
    "adapter_config.json": "peft's settings",
    "adapter_model.safetensors": "LoRA weights",
    "camera_token.safetensors": "adapted camera token",
    "freegeo.json": "base model, recipe, seed, scenes, loss curve",
    "epochs": "the adapter after every epoch",
    "published": "the adapter in the authors' layout",
}


def adapt(
    *sources: str,
    output: OutputOptions,
    model: ModelOptions = DEFAULT_MODEL,
    recipe: RecipeOptions = DEFAULT_RECIPE,
    photos: PhotoOptions = DEFAULT_PHOTOS,
    cameras: CameraOptions = NO_CAMERAS,
    published: bool = False,
    guard: Guard = "select",
) -> None:
    """Adapt a model to scenes; several folders make one adapter for all of them.

    Parameters
    ----------
    sources
        Folders of photos (each a scene), globs in quotes, photo files (together one scene), videos, or `demo`.
    published
        Also write the adapter in the layout of the authors' release, below `published`.
    guard
        select: matches between the photos decide which state of the adapter is saved; report: they are only asked;
        off.
    """
    from freegeo.adaptation.recipe import require_unchanged_images
    from freegeo.data.photos import MAX_VIEWS
    from freegeo.errors import UserError
    from freegeo.models.images import chosen_side, read_photos
    from freegeo.pipeline import require_enough_photos, scene_images
    from freegeo.posed import check_known, told
    from freegeo.run_folder import run_folder
    from freegeo.runs import LABELS, check_inputs, check_place, size_settings

    check_place(output.output, overwrite=output.overwrite)
    empty = model.build_empty()
    empty.adaptable()
    chosen_side(empty.spec, photos.process_res)
    plan = recipe.build(empty.spec)
    photos = replace(photos, max_views=MAX_VIEWS if photos.max_views is None else photos.max_views)
    scenes = {str(part[0]): load_source(part, photos) for part in split_scenes(sources)}
    if output.overwrite:
        check_inputs(output.output, [photo for found in scenes.values() for photo in found], cameras.cameras)
    model.warn_of_embedded(sources)
    for found in scenes.values():
        require_enough_photos(found)
    if cameras.cameras is not None and len(scenes) > 1:
        raise UserError(f"--cameras is for one scene, and there are {len(scenes)}. Adapt to one, or leave it out.")
    name = next(iter(scenes))
    scenes[name], known = cameras.read(scenes[name])
    batches = {
        name: read_photos(empty, found, mixed=photos.mixed, process_res=photos.process_res)
        for name, found in scenes.items()
    }
    priors, sentence = told(known, batches[name], empty.spec)
    if sentence:
        console.note(sentence)
    if priors is not None:
        require_unchanged_images(plan)
    about = {name: {"photos": list(batch.names), "contents": batch.digest()} for name, batch in batches.items()}
    settings = {
        "command": "adapt", "scenes": about, "published": published, "guard": guard, **model.identity(plan),
        "recipe": asdict(plan), **({} if priors is None else {"known_cameras": priors.digest()}),
        **size_settings(batches[name]),
    }  # fmt: skip
    with run_folder(output.output, settings, overwrite=output.overwrite, labels=LABELS) as folder:
        if folder.finished:
            say_finished(output.output, folder.finished_at)
            return
        if priors is not None and known is not None and not cameras.trust_cameras:
            console.note("known cameras against matches between the photos ...")
            check_known(known, scenes[name])
        loaded = model.load()
        images = [scene_images(name, scenes[name], loaded, plan, batch, priors) for name, batch in batches.items()]
        pairs = [(found, batches[name]) for name, found in scenes.items()]
        _train(loaded, images, plan, model, folder.path, published=published, guard=guard, scenes=pairs)
        folder.finish()
    console.written(output.output, FILES)


def _train(
    loaded: ReconstructionModel,
    images: list[SceneImages],
    plan: Recipe,
    model: ModelOptions,
    folder: Path,
    *,
    published: bool,
    guard: Guard,
    scenes: Sequence[tuple[Sequence[PhotoLike], ImageBatch]],
) -> None:
    from freegeo.adaptation.adapt import adapt as train_adapter
    from freegeo.adaptation.adapter_files import export_published, save_adapter
    from freegeo.errors import FreeGeoError
    from freegeo.evidence.guard import SHARES
    from freegeo.guarded import Evidence
    from freegeo.pipeline import before_training, judge_by_photos

    def keep_epoch(epoch: int, adapter) -> None:
        if plan.epochs is not None:
            about = {"epoch": epoch, "scenes": [scene.name for scene in images], "seed": model.seed}
            save_adapter(adapter, folder / "epochs" / f"epoch_{epoch}", about)

    compute = model.compute()
    if plan.cameras:
        console.note("cameras to learn from ...")
    images, frozen, judging = before_training(
        loaded, images, scenes, plan, guard=guard, seed=model.seed, compute=compute
    )
    with step_bar() as on_step:
        result = train_adapter(
            loaded, images, plan, seed=model.seed, compute=compute, resume_in=folder, on_step=on_step,
            on_epoch=keep_epoch, keep_after=() if guard == "off" else SHARES,
        )  # fmt: skip
    if result.trouble is None:
        nothing = [None] * len(images)
        evidence = [
            Evidence.in_memory(photos, batch, before, priors=one.priors, matches=matches, name=one.name)
            for one, (photos, batch), before, matches in zip(
                images, scenes, frozen or nothing, judging or nothing, strict=True
            )
        ]
        judge_by_photos(loaded, result, evidence, compute=compute, guard=guard)
    result.save(folder)
    if result.trouble:
        raise FreeGeoError(f"{folder}: {result.trouble} The adapter is there to be looked at; do not use it.")
    if published:
        export_published(result.adapter, folder / "published")
    change = result.loss_change()
    console.say(f"adaptation loss {change['first']:.4f} -> {change['last']:.4f} in {result.seconds:.0f} s")
    console.say(f"licence of the weights: {loaded.spec.weights_licence}")
