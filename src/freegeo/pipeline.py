"""Photos -> adapter -> reconstruction: the functions of the Python interface, and what the commands build on."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import torch

from freegeo.adaptation import adapter_files
from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapt import adapt as train_adapter
from freegeo.adaptation.adapted import Adapted
from freegeo.adaptation.adapter import Adapter, is_adapted
from freegeo.adaptation.recipe import SEED, SMALLEST_SCENE, Guard, Recipe, require_guard
from freegeo.adaptation.samples import SceneImages
from freegeo.adaptation.state import OwnLoss, Progress
from freegeo.data.photos import MAX_VIEWS, load_photos
from freegeo.errors import FreeGeoError, UserError
from freegeo.evidence.bundle import pycolmap_module
from freegeo.evidence.guard import SHARES
from freegeo.evidence.matches import Matches
from freegeo.export.reconstruction import Reconstruction
from freegeo.guarded import Evidence, harm, judge_adapter, scene_matches
from freegeo.metres import in_metres, read_scale
from freegeo.models.api import ReconstructionModel, embed_in_chunks
from freegeo.models.catalog import caution_of
from freegeo.models.images import read_photos
from freegeo.models.memory import plan_reconstruction
from freegeo.models.precision import Compute
from freegeo.models.spec import MIXED, Mixed, ModelSpec, PoseFrom
from freegeo.posed import (
    check_known,
    doubt_focal_length,
    is_measurable,
    is_one_camera,
    known_cameras,
    require_cameras,
    told,
    with_known_cameras,
    with_measured_depth,
    with_one_camera,
)
from freegeo.progress import step_bar
from freegeo.taught import lesson
from freegeo.types import ImageBatch, PhotoLike, Priors

if TYPE_CHECKING:
    from freegeo.cameras.known import KnownCameras
    from freegeo.data.photos import PhotoSource

logger = logging.getLogger(__name__)

CPU = Compute()
_warned_of: list[str] = []


def predict(
    model: ReconstructionModel,
    batch: ImageBatch,
    *,
    reference: str | None = None,
    priors: Priors | None = None,
    pose_from: PoseFrom = "camera",
    compute: Compute = CPU,
) -> Reconstruction:
    """Reconstruct prepared images with the model and the adapter that is on, if any.

    `reference` None is the model's own rule, with and without an adapter: results before and after adaptation differ in
    nothing else. The model is told `priors`; the cameras of the result are those that it predicts. UserError when the
    images do not fit into memory together, FreeGeoError when the model answers with values that are not finite.
    """
    result = predict_unchecked(model, batch, reference=reference, priors=priors, pose_from=pose_from, compute=compute)
    trouble = not_finite(result)
    if trouble:
        raise FreeGeoError(f"{trouble} Try --precision fp32, and check the weights.")
    return result


@torch.no_grad()
def predict_unchecked(
    model: ReconstructionModel,
    batch: ImageBatch,
    *,
    reference: str | None,
    priors: Priors | None,
    pose_from: PoseFrom,
    compute: Compute,
) -> Reconstruction:
    """Predict as `predict`, and return values that are not finite too (`not_finite`)."""
    require_reference(reference, priors)
    plan_reconstruction(model, len(batch), batch.image_hw, compute=compute)
    batch = batch.read()
    model.to(compute.device).eval()
    with compute.autocast():
        tokens = embed_in_chunks(model, batch.images, device=compute.device)
        features = model.aggregate(tokens, reference=reference or model.spec.reference, priors=priors)
        if pose_from == "rays":
            prediction = model.decode(features, want=("depth", "ray_cameras"))
        else:
            prediction = model.decode(features)
    return Reconstruction.from_prediction(prediction, batch)


def require_reference(reference: str | None, priors: Priors | None) -> None:
    """Raise UserError for a rule of the reference view where the model is told cameras, which leave no choice."""
    if priors is not None and reference not in (None, "first"):
        raise UserError(
            f"the first photo is the reference view where the model is told cameras, not that of the rule "
            f"'{reference}'. Leave --reference out."
        )


def require_pose_from(spec: ModelSpec, pose_from: PoseFrom, recipe: Recipe | None = None) -> None:
    """Raise UserError when cameras cannot come from there, or are not those that a recipe teaches."""
    if pose_from not in get_args(PoseFrom):
        raise UserError(f"cameras come from {' or '.join(get_args(PoseFrom))}, not {pose_from!r}.")
    if pose_from == "rays" and not spec.ray_cameras:
        raise UserError(f"{spec.name} finds no cameras from rays; only the any-view models of Depth Anything 3 do.")
    if pose_from == "rays" and recipe is not None and recipe.cameras:
        raise UserError(
            f"recipe {recipe.name} teaches the camera head, which --pose-from rays does not read. Leave out one of "
            "them."
        )


def capital(sentence: str) -> str:
    """Return a sentence with a capital letter at its beginning."""
    return sentence[0].upper() + sentence[1:]


def not_finite(result: Reconstruction) -> str | None:
    """Return a sentence when cameras, or all depth of a view, are not finite numbers; None for a usable result."""
    dead = ~np.isfinite(result.depth_z).any(axis=(1, 2))
    if result.has_cameras:
        for values in result.cameras():
            dead |= ~np.isfinite(values).all(axis=(1, 2))
    if not dead.any():
        return None
    return f"The model's answer is not a finite number for {dead.sum()} of {len(result)} views."


def reconstruct(
    model: ReconstructionModel,
    photos: PhotoSource,
    *,
    adapter: Adapter | str | Path | None = None,
    cameras: KnownCameras | str | Path | None = None,
    trust_cameras: bool = False,
    one_camera: bool | None = None,
    scale: str | None = None,
    reference: str | None = None,
    device: str | None = None,
    precision: str | None = None,
    max_views: int = MAX_VIEWS,
    mixed: Mixed = MIXED,
    process_res: int | None = None,
    pose_from: PoseFrom = "camera",
) -> Reconstruction:
    """Reconstruct photos: depth, confidence and cameras of every view.

    Args:
        model: from `freegeo.load_model`; it is moved to the device.
        photos: what `freegeo.load_photos` takes or returned.
        adapter: an adapter of this model, or the folder of a saved one; it is used for this call, and the model is left
            as it was. None: the model in its present state, with the adapter that is on, if there is one.
        cameras: known cameras of the photos, wholly or in part: what `freegeo.read_cameras` returned, or a file that it
            reads. The model is told them where it can take them, and the result has them as they were given.
        trust_cameras: use poses without checking them by the matches between the photos.
        one_camera: photos of one camera (same size, same EXIF data) share one focal length; None: frames of a video do.
        scale: where metres come from: `gps`, a measured distance such as "IMG_1.jpg:812,410 IMG_2.jpg:655,398 = 1.25",
            or a text file of these.
        reference: rule of the reference view; None: the model's own, with and without an adapter.
        device: cpu, cuda, cuda:N or mps; None: the best available.
        precision: fp32, bf16 or fp16; None: bf16 on CUDA, else fp32.
        max_views: most photos that are used; a list that `freegeo.load_photos` returned is used whole.
        mixed: how photos of different shapes become images of one size: `crop` fits the odd ones to the others, `pad`
            puts white around all, `upstream` is the rule of the model's authors. Cutting more than 10 % of a photo
            gives a warning.
        process_res: longest side of the model's images in pixels, rounded to whole patches; None: the model's default.
            More takes more memory and time. An adapter should be used at the size that it was trained at.
        pose_from: `camera`: cameras of the model's camera head; `rays`: found from the rays that an any-view model of
            DA3 predicts.

    Raises:
        UserError: an argument that cannot be used, or views that do not fit into memory together.
    """
    require_model(model)
    require_pose_from(model.spec, pose_from)
    warn_of_model(model)
    compute = Compute.choose(device, precision)
    if cameras is not None or scale is not None:
        require_cameras(model.spec)
    found, known, matches = _with_cameras(load_photos(photos, max_views), cameras, trust=trust_cameras)
    source = None if scale is None else read_scale(scale, found)
    batch = read_photos(model, found, mixed=mixed, process_res=process_res)
    priors = _told(known, batch, model.spec)
    if isinstance(adapter, str | Path):
        about = adapter_files.adapter_metadata(adapter_files.find_adapter(adapter)) or {}
        if said := other_use(about, priors):
            logger.warning("%s: %s", adapter, said)
    with _applied(model, adapter):
        if said := other_size(model, batch):
            logger.warning("%s", said)
        result = predict(model, batch, reference=reference, priors=priors, pose_from=pose_from, compute=compute)
    if known is not None:
        posed = with_known_cameras(result, known)
        if is_measurable(posed, known):
            if matches is None:
                matches = scene_matches(found, result, None, device=str(compute.device))
            posed = with_measured_depth(posed, known, matches)
        result = posed.result
    if is_one_camera(found) if one_camera is None else one_camera:
        result, _ = with_one_camera(result, found, known)
    doubt_focal_length(result, found)
    return result if source is None else in_metres(result, source, found)


def _with_cameras(
    photos: Sequence[PhotoLike], cameras: KnownCameras | str | Path | None, *, trust: bool
) -> tuple[Sequence[PhotoLike], KnownCameras | None, Matches | None]:
    """Return the photos with their cameras, which matches check unless they are trusted, and these matches.

    UserError for distortion: exports write the photos that they are given, which would be the caller's distorted ones.
    """
    if cameras is None:
        return photos, None, None
    seen, known = known_cameras(photos, cameras)
    if any(new is not old for new, old in zip(seen, photos, strict=True)):
        raise UserError(
            f"{known.source}: the photos have distortion. Undistort them, and use the new photos from then on: photos, "
            "known = freegeo.cameras.undistortion.undistorted(photos, known)."
        )
    return photos, known, None if trust else check_known(known, photos)


def _told(known: KnownCameras | None, batch: ImageBatch, spec: ModelSpec) -> Priors | None:
    """Return what a model is told of known cameras, and say so."""
    priors, sentence = told(known, batch, spec)
    if sentence:
        logger.info("%s", sentence)
    return priors


def _applied(model: ReconstructionModel, adapter: Adapter | str | Path | None) -> AbstractContextManager[None]:
    """Return a context in which an adapter is on; afterwards the model is as it was."""
    if adapter is None:
        return nullcontext()
    if isinstance(adapter, str | Path):
        return _loaded(model, adapter)
    if not isinstance(adapter, Adapter):
        given = type(adapter).__name__
        raise UserError(f"adapter is an Adapter (such as result.adapter) or the folder of a saved one, not {given}.")
    if adapter.model is not model.adaptable():
        raise UserError(
            f"{adapter} belongs to another model than the one given. Give that model, or save the adapter and load it "
            "with freegeo.load_adapter."
        )
    return adapter.applied()


def other_use(metadata: Mapping[str, Any], priors: Priors | None) -> str | None:
    """Say that an adapter was trained with known cameras and is used without, or the reverse; None where it was not."""
    trained = bool(metadata.get("with_cameras"))
    if not metadata or trained == (priors is not None):
        return None
    with_or_without = (
        "with known cameras, and is used without" if trained else "without known cameras, and is used with"
    )
    return f"the adapter was trained {with_or_without} them, for which it was not made."


def other_size(model: ReconstructionModel, batch: ImageBatch) -> str | None:
    """Say that the adapter that is on was trained at another size than that of the images; None where it was not."""
    part, size = model.cross_view, batch.process_res or model.spec.default_side
    if part is None or not is_adapted(part) or part.adapted_at in (None, size):
        return None
    return (
        f"the adapter was trained on images of {part.adapted_at} pixels and is used on {size}, for which it was not "
        f"made: take --process-res {part.adapted_at}, or adapt again."
    )


@contextmanager
def _loaded(model: ReconstructionModel, folder: str | Path) -> Generator[None]:
    adapter = load_adapter(model, folder)
    try:
        yield
    finally:
        adapter.detach()


def load_adapter(model: ReconstructionModel, folder: str | Path) -> Adapter:
    """Attach a saved adapter to a model and switch it on; `adapter.detach()` and `adapter.reattach()` undo and redo it.

    UserError when the folder holds no adapter, when it was made for another model, or when the model carries one.
    """
    require_model(model)
    return adapter_files.load_adapter(model, folder)


def adapt(
    model: ReconstructionModel,
    photos: PhotoSource,
    *,
    recipe: str | Recipe = "scene",
    dataset: str | None = None,
    steps: int | None = None,
    epochs: int | None = None,
    lr: float | None = None,
    rank: int | None = None,
    hold: float | None = None,
    views: int | None = None,
    keep: Sequence[int] | None = None,
    sets: int | None = None,
    loss: Mapping[str, Any] | None = None,
    seed: int = SEED,
    cameras: KnownCameras | str | Path | None = None,
    trust_cameras: bool = False,
    device: str | None = None,
    precision: str | None = None,
    max_views: int = MAX_VIEWS,
    mixed: Mixed = MIXED,
    process_res: int | None = None,
    guard: Guard = "select",
    own_loss: OwnLoss | None = None,
    resume_in: str | Path | None = None,
    progress: bool = False,
    on_step: Callable[[Progress], None] = lambda progress: None,
) -> Adapted:
    """Adapt a model to one scene's photos; the adapter stays attached (`result.adapter.detach()` takes it out).

    Settings left at None are those of the recipe; they mean what the options of `freegeo adapt` mean.

    Args:
        model: from `freegeo.load_model`, without an adapter; it is moved to the device.
        photos: at least 3; what `freegeo.load_photos` takes or returned.
        recipe: `scene`, `evidence`, `paper`, `released-da3`, `released-vggt`, or a recipe of your own. `evidence`
            learns from cameras that matches between the photos prove, and needs the extra `colmap`.
        dataset: with the last three of these names, the dataset whose published settings are used.
        steps: optimiser steps.
        epochs: passes over all view sets, instead of steps.
        lr: peak learning rate.
        rank: rank of the adapter.
        hold: weight of the distance between adapted and frozen features of all views.
        views: views the teacher sees.
        keep: positions among them that the student keeps, such as `(0, 2, 4, 6)`.
        sets: view sets per scene.
        loss: settings of the loss, such as `{"weight_kq": 0.0}`.
        seed: of everything random.
        cameras: known cameras of the photos, as for `reconstruct`; teacher and student are told them, where the model
            can take them. Otherwise they have no part in the adaptation.
        trust_cameras: use poses without checking them by the matches between the photos.
        device: cpu, cuda, cuda:N or mps; None: the best available.
        precision: fp32, bf16 or fp16; None: bf16 on CUDA, else fp32.
        max_views: most photos that are used; a list that `freegeo.load_photos` returned is used whole.
        mixed: how photos of different shapes become images of one size, as for `reconstruct`.
        process_res: longest side of the model's images, as for `reconstruct`.
        guard: `select`: matches between the photos decide in which state the adapter is used, and whether at all (its
            strength is 0 then; `result.verdict` says why); `report`: they are only asked; `off`.
        own_loss: a term of your own that is added to the loss. At every step it is called with the features of student
            and teacher, both of the views that the student sees (`freegeo.types.Features`), and returns a tensor with
            one number. The curve has it as `own`. A run is continued only with a function of the same name.
        resume_in: folder for the state of an unfinished run: the same call continues it. `result.save` to that folder
            removes the state.
        progress: show a bar in a terminal or notebook, lines in a log file; without it nothing is printed.
        on_step: called after every step.

    Raises:
        UserError: an argument that cannot be used, fewer than 3 photos, or a run that does not fit into memory.
        FreeGeoError: a loss or gradient that is not finite.
        NoEvidenceError: recipe `evidence`, and the matches between the photos prove no cameras.
    """
    require_model(model)
    require_guard(guard)
    model.adaptable()
    warn_of_model(model)
    compute = Compute.choose(device, precision)
    plan = named_recipe(recipe, model, dataset).changed(
        steps=steps, epochs=epochs, lr=lr, rank=rank, hold=hold, views=views,
        keep=None if keep is None else tuple(keep), sets_per_scene=sets, loss=loss,
    )  # fmt: skip
    if plan.cameras:
        pycolmap_module()
    found = load_photos(photos, max_views)
    require_enough_photos(found)
    found, known, _ = _with_cameras(found, cameras, trust=trust_cameras)
    batch = read_photos(model, found, mixed=mixed, process_res=process_res)
    priors = _told(known, batch, model.spec)
    images = [scene_images("photos", found, model, plan, batch, priors)]
    images, frozen, judging = before_training(
        model, images, [(found, batch)], plan, guard=guard, seed=seed, compute=compute
    )
    folder = None if resume_in is None else Path(resume_in).expanduser()
    with step_bar(on_step) if progress else nullcontext(on_step) as follow:
        result = train_adapter(
            model, images, plan, seed=seed, compute=compute, resume_in=folder, on_step=follow,
            keep_after=() if guard == "off" else SHARES, own_loss=own_loss,
        )  # fmt: skip
    if not result.trouble:
        scene = Evidence.in_memory(
            found, batch, None if frozen is None else frozen[0], priors=priors,
            matches=None if judging is None else judging[0],
        )  # fmt: skip
        judge_by_photos(model, result, [scene], compute=compute, guard=guard)
    if result.trouble:
        logger.warning("%s", capital(result.trouble))
    return result


def before_training(
    model: ReconstructionModel,
    images: list[SceneImages],
    scenes: Sequence[tuple[Sequence[PhotoLike], ImageBatch]],
    plan: Recipe,
    *,
    guard: Guard,
    seed: int,
    compute: Compute,
) -> tuple[list[SceneImages], list[Reconstruction] | None, list[Matches] | None]:
    """Ask the frozen model for what judges the adapter and, by some recipes, teaches it (`with_targets`).

    Photos that do not fit into memory together are refused here, before anything is trained.

    Returns:
        The scenes, with targets where the recipe learns from cameras; the frozen predictions, unless the guard is off;
        the matches that are left to judge by, where others teach.
    """
    if guard == "off" and not plan.cameras:
        return images, None, None
    frozen = [
        predict(model, batch, priors=one.priors, compute=compute)
        for one, (_, batch) in zip(images, scenes, strict=True)
    ]
    if not plan.cameras:
        return images, frozen, None
    taught, judging = with_targets(images, [photos for photos, _ in scenes], frozen, seed=seed, compute=compute)
    return taught, frozen, judging


def with_targets(
    images: Sequence[SceneImages],
    photos: Sequence[Sequence[PhotoLike]],
    frozen: Sequence[Reconstruction],
    *,
    seed: int,
    compute: Compute,
    stores: Sequence[Path | None] | None = None,
) -> tuple[list[SceneImages], list[Matches]]:
    """Give scenes the cameras that their photos prove, for a recipe that learns from them.

    Args:
        images: of the scenes.
        photos: of each scene.
        frozen: predictions of these photos.
        seed: decides which pairs of photos teach.
        compute: where depth maps are compared.
        stores: files for the matches of the scenes; None: they are not stored.

    Returns:
        The scenes with targets, and the matches that are left to judge by.

    Raises:
        NoEvidenceError: the matches of a scene prove no cameras.
    """
    lessons = [
        lesson(one.name, seen, before, store, seed=seed, device=str(compute.device))
        for one, seen, before, store in zip(images, photos, frozen, stores or [None] * len(images), strict=True)
    ]
    taught = [replace(one, targets=found.targets) for one, found in zip(images, lessons, strict=True)]
    return taught, [found.judging for found in lessons]


def judge_by_photos(
    model: ReconstructionModel,
    result: Adapted,
    scenes: Sequence[Evidence],
    *,
    compute: Compute,
    guard: Guard,
    reference: str | None = None,
    pose_from: PoseFrom = "camera",
) -> None:
    """Judge a finished adapter by the photos of its scenes, and keep the verdict in the result.

    Images and depth maps of one scene are in memory at a time, besides those that the caller keeps there.

    Args:
        model: with the adapter.
        result: the finished run. `verdict` is set unless the guard is off or the model predicts no cameras; with
            `select` the adapter is brought into the state that it allows. Where the adapter would be used as it was
            trained, and its predictions of a scene are broken, `harm` is set instead.
        scenes: scenes, or chunks of a sequence.
        compute: where predictions are made.
        guard: see `freegeo.guarded.judge_adapter`.
        reference: rule of the reference view.
        pose_from: where cameras of predictions come from.
    """

    def predicted(batch: ImageBatch, priors: Priors | None) -> Reconstruction:
        return predict_unchecked(model, batch, reference=reference, priors=priors, pose_from=pose_from, compute=compute)

    def finite(batch: ImageBatch, priors: Priors | None) -> Reconstruction | None:
        found = predicted(batch, priors)
        return found if not_finite(found) is None else None

    def without_adapter(scene: Evidence) -> Reconstruction:
        with result.adapter.off():
            return predict(
                model, scene.batch(), reference=reference, priors=scene.priors, pose_from=pose_from, compute=compute
            )

    judged = [
        scene if scene.frozen is not None else replace(scene, frozen=partial(without_adapter, scene))
        for scene in scenes
    ]
    asked = guard != "off" and judged[0].frozen_prediction().has_cameras
    if not asked or guard == "report":
        for scene in judged:
            try:
                before = scene.frozen_prediction()
            except UserError as error:
                if guard != "off":
                    raise
                logger.warning("Nobody looked at what the adapter does to predictions: %s", error)
                return
            found = predicted(scene.batch(), scene.priors)
            wrong = not_finite(found) or harm(before, found)
            if wrong:
                where = f"{scene.name}: " if len(scenes) > 1 else ""
                result.harm = f"{where}{wrong} Lower --lr (now {result.recipe.lr:g}) or take fewer --steps."
                return
    if not asked:
        return
    verdict = judge_adapter(result, judged, finite, device=str(compute.device), select=guard == "select")
    logger.info("%s", verdict.reason)
    result.verdict = verdict.as_dict()


def named_recipe(recipe: str | Recipe, model: ReconstructionModel, dataset: str | None) -> Recipe:
    """Return a recipe for a model; UserError for a name that is none, or a dataset that has no part in it."""
    if isinstance(recipe, str):
        return recipes.named(recipe, model.spec, dataset)
    if not isinstance(recipe, Recipe):
        raise UserError(f"recipe is a name such as 'scene', or a Recipe, not {type(recipe).__name__}.")
    if dataset is not None:
        raise UserError("dataset chooses the settings of a recipe that is given by name; change the recipe instead.")
    return recipe


def require_model(model: object) -> None:
    """Raise UserError for something that is no model, such as the name of one."""
    if isinstance(model, ReconstructionModel):
        return
    hint = f"freegeo.load_model({model!r})" if isinstance(model, str) else "freegeo.load_model"
    raise UserError(f"model is a loaded model, not {type(model).__name__}. Load it with {hint}.")


def warn_of_model(model: ReconstructionModel) -> None:
    """Say once what a model is not for, or what its results lack."""
    name, caution = model.spec.name, caution_of(model.spec)
    if caution and name not in _warned_of:
        _warned_of.append(name)
        logger.warning("%s", caution)


def scene_images(
    name: str,
    photos: Sequence[PhotoLike],
    model: ReconstructionModel,
    recipe: Recipe,
    batch: ImageBatch,
    priors: Priors | None = None,
) -> SceneImages:
    """Return photos as a scene to adapt to: `batch`, or the photos themselves for a recipe with a size of its own."""
    if recipe.squash is None:
        scene = SceneImages.from_batch(name, batch)
    else:
        if batch.process_res is not None:
            logger.warning(
                "recipe %s adapts to images of %d x %d pixels whatever is asked for: --process-res %d is the size of "
                "predictions alone.", recipe.name, recipe.squash, recipe.squash, batch.process_res,
            )  # fmt: skip
        scene = SceneImages.from_photos(name, photos, model, recipe)
    return replace(scene, priors=priors)


def require_enough_photos(photos: Sequence[PhotoLike]) -> None:
    """Raise UserError when there are too few photos to hold one out."""
    if len(photos) < SMALLEST_SCENE:
        raise UserError(
            f"adaptation needs at least {SMALLEST_SCENE} photos, got {len(photos)}. Add photos, or reconstruct without "
            "adapting (--no-adapt, or `freegeo reconstruct`)."
        )
