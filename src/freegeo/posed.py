"""Known cameras: what a model is told of them, and what they make of its prediction (docs/scale.md)."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from freegeo.cameras.convention import check_convention, pairs_to_check
from freegeo.cameras.exif import exif_focal
from freegeo.cameras.known import KnownCameras
from freegeo.cameras.reading import read_cameras
from freegeo.cameras.undistortion import UndistortedPhoto, undistorted
from freegeo.data.image_files import UnreadableImageError, opened
from freegeo.data.photos import some_of
from freegeo.data.video import VideoFrame
from freegeo.errors import FreeGeoError, UserError
from freegeo.evidence.matches import ALL_PAIRS_UP_TO, Matches, find_matches, stored_matches
from freegeo.evidence.refinement import measured_depth
from freegeo.export.photos import own_file
from freegeo.export.pixels import HALF
from freegeo.export.reconstruction import Reconstruction, Scale
from freegeo.geometry.rotation import rotation_angle
from freegeo.geometry.se3 import camera_centres, from_Rt
from freegeo.geometry.sim3 import NORMAL, CameraFit, DegenerateAlignmentError, Sim3, fit_cameras
from freegeo.models.priors import usable
from freegeo.models.spec import ModelSpec
from freegeo.types import ImageBatch, PhotoLike, Priors

if TYPE_CHECKING:
    from pathlib import Path

logger = logging.getLogger(__name__)

FARTHEST = 1000.0
"""Distance of known cameras from the origin, in distances of the cameras farthest apart, above which they are refused:
points and meshes are float32, and would be rounded to more than 1e-4 of that distance."""
DOUBTFUL_DEG, DOUBTFUL_SHARE, DOUBTFUL_SPREAD, DOUBTFUL_FOCAL = 10.0, 0.2, 0.3, 0.05
"""From here on a difference between predicted and known cameras is a warning: median angle, median distance as a share
of the longest one between known cameras, spread of the pairs' scale, and relative difference of focal lengths."""
_EXIF, _CAMERA_TAGS, _FOCAL_TAGS = 0x8769, (0x010F, 0x0110), (0x920A, 0xA405)
EXIF_FACTOR = 1.3
"""Factor, up or down, from which on EXIF data and a result contradict each other: both are wrong by some per cent."""


def known_cameras(
    photos: Sequence[PhotoLike], cameras: KnownCameras | str | Path
) -> tuple[list[PhotoLike], KnownCameras]:
    """Bring cameras to photos: read them where a file is named, and undistort the photos where they have distortion.

    UserError for cameras that cannot be used for these photos.
    """
    known = cameras if isinstance(cameras, KnownCameras) else read_cameras(cameras, photos)
    if known.names != tuple(photo.name for photo in photos):
        raise UserError(
            f"{known.source}: the cameras are of {len(known)} photos ({some_of(known.names)}), not of these "
            f"{len(photos)}. Read them with freegeo.read_cameras and the same photos."
        )
    if not (known.has_pose | known.has_K).any():
        raise UserError(f"{known.source}: nothing is known of the cameras of these photos.")
    require_near(known)
    return undistorted(photos, known)


def require_cameras(spec: ModelSpec) -> None:
    """Raise UserError for a model without cameras, whose depth cannot be brought to known ones or to a scale."""
    if not spec.cameras:
        raise UserError(
            f"{spec.name} predicts no cameras, so known ones and a scale cannot be used. Leave --cameras and --scale "
            "out, or use a model that predicts cameras."
        )


def require_near(known: KnownCameras) -> None:
    """Raise UserError for cameras so far from the origin that points lose their digits (as map coordinates are)."""
    centres = camera_centres(_poses(known)).numpy()
    if len(centres) < 2:
        return
    extent = float(np.linalg.norm(centres[:, None] - centres, axis=-1).max())
    if extent > 0 and np.abs(centres).max() > FARTHEST * extent:
        middle = ", ".join(f"{value:.0f}" for value in np.median(centres, axis=0))
        raise UserError(
            f"{known.source}: the cameras are {extent:.4g} apart and {np.abs(centres).max():.4g} from the origin, so "
            f"far that points would be rounded. Subtract ({middle}) from all positions, and give the cameras again."
        )


def check_known(known: KnownCameras, photos: Sequence[PhotoLike], store: Path | None = None) -> Matches | None:
    """Check known poses by matches between the photos: UserError where they do not fit, a warning without evidence.

    `store` is the file for the matches of a scene, which is read where it is there, and written when they fit. Returns
    the matches where they are of all pairs of photos.
    """
    if known.has_pose.sum() < 2:
        return None
    few = len(photos) <= ALL_PAIRS_UP_TO
    if not few:
        # Those without a pose say nothing of the others, between which pairs may be left out.
        views = np.flatnonzero(known.has_pose).tolist()
        known, photos = known.select(views), [photos[view] for view in views]
    pairs = pairs_to_check(len(photos))
    # Of more photos other pairs are matched later, by what the prediction says that they see of each other.
    store = store if few else None
    is_there = store is not None and store.is_file()
    matches = stored_matches(store, photos, pairs) if store is not None and is_there else find_matches(photos, pairs)
    found = check_convention(known, matches)
    found.require()
    logger.info("%s", found.sentence)
    if store is not None and not is_there:
        matches.save(store)
    return matches if few else None


def digest(known: KnownCameras) -> str:
    """Return a fingerprint of everything that is known."""
    values = hashlib.sha256(repr((known.names, known.metric)).encode())
    for camera in known.cameras:
        values.update(repr(camera.lens).encode())
        for matrix in (camera.T_cam_world, camera.K):
            values.update(b"-" if matrix is None else np.ascontiguousarray(matrix, np.float64).tobytes())
    return values.hexdigest()[:16]


def priors_of(known: KnownCameras, batch: ImageBatch) -> Priors:
    """Return known cameras of undistorted photos as priors for a model that reads their `batch`."""
    has_pose, has_K = (torch.from_numpy(mask) for mask in (known.has_pose, known.has_K))
    T = torch.eye(4, dtype=torch.float64).repeat(1, len(known), 1, 1)
    T[0, has_pose] = _poses(known)
    return Priors(
        T_cam_world=T if has_pose.any() else None,
        K=model_K(known, batch.scale_xy, batch.offset_xy)[None] if has_K.any() else None,
        has_pose=has_pose,
        has_K=has_K,
        metric=known.metric,
    )


def told(known: KnownCameras | None, batch: ImageBatch, spec: ModelSpec) -> tuple[Priors | None, str | None]:
    """Return what a model is told of known cameras, and what to say about that; (None, None) without any."""
    return (None, None) if known is None else told_of(known, priors_of(known, batch), spec)


def told_in_chunks(known: KnownCameras | None, batch: ImageBatch, spec: ModelSpec) -> tuple[Priors | None, str | None]:
    """Do as `told` for photos that are predicted in chunks, each of which is told what it can take of its own photos.

    The priors may hold what the model can take in some chunks only (`freegeo.models.priors.usable`).
    """
    priors, sentence = told(known, batch, spec)
    if known is not None and spec.takes == "parts" and known.has_pose.any() and not known.has_pose.all():
        return priors_of(known, batch), (
            f"{spec.name} is told, in each chunk, what it can take of the poses of {int(known.has_pose.sum())} and the "
            f"intrinsics of {int(known.has_K.sum())} photos in {known.source}."
        )
    if known is None or priors is not None or spec.takes != "cameras":
        return priors, sentence
    whole = int((known.has_pose & known.has_K).sum())
    if not whole:
        return priors, sentence
    return priors_of(known, batch), (
        f"{spec.name} takes poses and intrinsics of all photos of a chunk, or none: both are known of {whole} of "
        f"{len(known)} photos, and chunks with others see the photos alone."
    )


def told_of(known: KnownCameras, found: Priors, spec: ModelSpec) -> tuple[Priors | None, str]:
    """Return what a model is told of priors that were made of known cameras, and what to say about that."""
    priors, left_out = usable(found, spec)
    if priors is None:
        return None, f"{left_out} The cameras of {known.source} have no part in its prediction."
    sentence = f"{spec.name} is told the cameras of {known.source}{_parts_of(priors)}."
    return priors, f"{sentence} {left_out}" if left_out else sentence


def _parts_of(priors: Priors) -> str:
    """Say of how many photos which part is known, where that is not everything of all."""
    if priors.whole_cameras:
        return ""
    masks = (("poses", priors.T_cam_world, priors.has_pose), ("intrinsics", priors.K, priors.has_K))
    parts = [f"{name} of {int(mask.sum())}" for name, values, mask in masks if values is not None and mask is not None]
    return f": {' and '.join(parts)} photos"


def model_K(known: KnownCameras, scale_xy: Tensor, offset_xy: Tensor) -> Tensor:
    """Known intrinsics (S, 3, 3) float64 in pixels of a model's images; the identity where none are known.

    The inverse of `freegeo.export.pixels.corner_K`: known ones are counted from the photo's corner.
    """
    K = torch.stack([_or_identity(camera.K, 3) for camera in known.cameras])
    rows = K[:, :2] * scale_xy[:, :, None]
    rows[:, :, 2] += offset_xy - HALF
    moved = torch.cat([rows, K[:, 2:]], dim=1)
    return torch.where(torch.from_numpy(known.has_K)[:, None, None], moved, torch.eye(3, dtype=torch.float64))


@dataclass(frozen=True, kw_only=True, eq=False)
class Posed:
    """A prediction with known cameras."""

    result: Reconstruction
    about: Mapping[str, Any]
    """JSON-like: `source`, `poses` and `intrinsics` (how many are known), `metric`, `scale`, `spread`, `rotation_deg`,
    `position` (`freegeo.geometry.sim3.CameraFit`), `focal` (median ratio of known to predicted focal lengths); None
    where there is none. With `with_measured_depth` also `measured`: `points`, `views` with enough of them, `factor` and
    `spread` over the views (None: one view); None where too few were measured."""


def with_known_cameras(prediction: Reconstruction, known: KnownCameras) -> Posed:
    """Bring a prediction into the world of known cameras, and return these as they were given.

    Views whose pose is not known move along with the others. Depth is multiplied by the scale of the fit. Where only
    intrinsics are known, depth stays as the model predicted it. Warnings say what does not fit.

    Raises:
        UserError: the model predicts no cameras.
        FreeGeoError: the predicted cameras give no scale.
    """
    if not prediction.has_cameras:
        raise UserError(
            f"the model predicts no cameras, so its depth cannot be brought to those of {known.source}. Use a model "
            "that predicts cameras, or leave --cameras out."
        )
    T, K = (torch.from_numpy(value).double() for value in prediction.cameras())
    has_pose, has_K = torch.from_numpy(known.has_pose), torch.from_numpy(known.has_K)
    scale, depth_z, fit, focal = prediction.scale, prediction.depth_z, None, None
    if has_pose.any():
        given = _poses(known)
        try:
            fit = fit_cameras(T[has_pose], given)
        except DegenerateAlignmentError:
            raise FreeGeoError(
                "the model predicts all cameras in one place, so that its depth cannot be brought to the scale of the "
                "known ones. Use photos with more motion, or another model."
            ) from None
        T = fit.sim3.apply_to_cameras(T)
        T[has_pose] = given
        factor = float(fit.sim3.s)
        depth_z = (depth_z * factor).astype(np.float32)
        _doubt_poses(fit, known, prediction.scale)
        if fit.has_scale:
            source = f"the known cameras in {known.source}"
            scale = Scale(value=factor, source=source, spread=fit.spread) if known.metric else None
    if has_K.any():
        wanted = model_K(known, torch.from_numpy(prediction.scale_xy), torch.from_numpy(prediction.offset_xy))
        focal = float((wanted / K)[has_K][:, (0, 1), (0, 1)].quantile(0.5))
        _doubt_focal(focal, known)
        K = torch.where(has_K[:, None, None], wanted, K)
    about = {
        "source": known.source, "poses": int(has_pose.sum()), "intrinsics": int(has_K.sum()), "metric": known.metric,
        "scale": None if fit is None or not fit.has_scale else float(fit.sim3.s),
        "spread": None if fit is None else fit.spread,
        "rotation_deg": None if fit is None else fit.rotation_deg,
        "position": None if fit is None else fit.position,
        "focal": focal,
    }  # fmt: skip
    result = replace(prediction, depth_z=depth_z, T_cam_world=T.numpy(), K=K.numpy(), scale=scale)
    return Posed(result=result, about=about)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tied:
    """Cameras of photos that were predicted in chunks, in the world of the known ones among them."""

    T_cam_world: np.ndarray
    scale: Scale | None
    """What lengths being metres rests on; None: up to scale."""
    about: Mapping[str, Any]
    """`scale`, `rotation_deg` and `position`, as in `Posed.about`."""


def with_poses(
    T_cam_world: np.ndarray,
    stretches: Sequence[Sequence[int]],
    known: KnownCameras,
    factor: float,
    scale: Scale | None,
) -> Tied:
    """Return known poses of some frames of a sequence as they were given, and let the frames between them follow.

    What a known pose lacks to the one it takes the place of is a turn and a shift; frames between two known poses are
    turned and shifted by what lies between these, so that the path and its surfaces have no jumps. Warnings say where
    the cameras were far from the known ones.

    Args:
        T_cam_world: (S, 4, 4) of the frames, placed in the world of the known poses.
        stretches: ascending numbers of these frames, in parts between which the sequence is cut: no frame follows a
            known pose on the other side of a cut.
        known: of the frames, with the poses that are used.
        factor: by which placing them multiplied depth.
        scale: of the prediction.
    """
    rows = np.flatnonzero(known.has_pose)
    about = {"scale": factor, "rotation_deg": None, "position": None}
    metres = Scale(value=factor, source=f"the known cameras in {known.source}", spread=None) if known.metric else None
    if not len(rows):
        return Tied(T_cam_world=T_cam_world, scale=metres, about=about)
    given, placed = _poses(known), torch.from_numpy(T_cam_world[rows]).double()
    shift = camera_centres(given) - camera_centres(placed)
    longest = float(torch.cdist(camera_centres(given), camera_centres(given)).max())
    angle = torch.rad2deg(rotation_angle(placed[:, :3, :3], given[:, :3, :3]).quantile(0.5))
    position = float(shift.norm(dim=-1).quantile(0.5)) / longest if longest > 0 else None
    sim3 = replace(Sim3.identity(), s=torch.tensor(factor, dtype=torch.float64))
    fit = CameraFit(sim3=sim3, has_scale=True, spread=None, rotation_deg=float(angle), position=position)
    _doubt_poses(fit, known, scale)
    moved = torch.from_numpy(T_cam_world.copy())
    start = 0
    for frames in stretches:
        end = start + len(frames)
        own = np.flatnonzero((rows >= start) & (rows < end))
        if len(own):
            moved[start:end] = _following(moved[start:end], frames, rows[own] - start, given[own])
        start = end
    about |= {"rotation_deg": float(angle), "position": position}
    return Tied(T_cam_world=moved.numpy(), scale=metres, about=about)


def _following(T_cam_world: Tensor, frames: Sequence[int], rows: np.ndarray, given: Tensor) -> Tensor:
    """Poses of the frames of one stretch: those of `rows` as given, the others turned and shifted as these are."""
    from scipy.spatial.transform import Rotation, Slerp

    placed = T_cam_world[rows].double()
    shift = camera_centres(given) - camera_centres(placed)
    # Before the first and after the last of them everything follows that one.
    around = np.concatenate(([0], np.arange(len(rows)), [len(rows) - 1]))
    times = [frames[0] - 1, *(frames[row] for row in rows), frames[-1] + 1]
    turns = Slerp(times, Rotation.from_matrix((given[:, :3, :3].mT @ placed[:, :3, :3]).numpy()[around]))(frames)
    shifts = np.stack([np.interp(frames, times, values) for values in shift.numpy()[around].T], axis=1)
    R = T_cam_world[:, :3, :3] @ torch.from_numpy(turns.as_matrix()).mT
    moved = from_Rt(R, -(R @ (camera_centres(T_cam_world) + torch.from_numpy(shifts))[..., None]).squeeze(-1))
    moved[rows] = given
    return moved


def is_measurable(posed: Posed, known: KnownCameras) -> bool:
    """Whether matches can measure points with known cameras: those of all photos are known, from different places."""
    return bool(known.has_pose.all() and known.has_K.all()) and posed.about["scale"] is not None


def with_measured_depth(posed: Posed, known: KnownCameras, matches: Matches) -> Posed:
    """Bring depth to the points that matches measure with known cameras (`is_measurable`).

    A network's depth and its cameras differ in scale, and each view's depth has a factor of its own: where distances of
    cameras alone give the scale, surfaces lie beside each other.
    """
    found = measured_depth(posed.result, matches)
    if found is None:
        logger.warning(
            "%s: too few points could be measured with the known cameras: depth keeps the scale that the distances "
            "between cameras give it.",
            known.source,
        )
        return replace(posed, about={**posed.about, "measured": None})
    own = found.factors[found.own]
    factor = float(np.median(own))
    spread = NORMAL * float(np.median(np.abs(np.log(own / factor)))) if len(own) > 1 else None
    scale = posed.result.scale
    if scale is not None:
        scale = replace(scale, value=scale.value * factor, spread=spread)
    about = {"points": found.points, "views": int(found.own.sum()), "factor": factor, "spread": spread}
    return Posed(
        result=replace(posed.result, depth_z=found.depth_z, scale=scale), about={**posed.about, "measured": about}
    )


def doubt_focal_length(result: Reconstruction, photos: Sequence[PhotoLike]) -> None:
    """Warn when a result's focal lengths are far from those that the photos' EXIF data say."""
    if not result.has_cameras:
        return
    focal = result.photo_K()[:, (0, 1), (0, 1)].mean(axis=1)
    ratios = [
        known / found
        for photo, found in zip(photos, focal, strict=True)
        if (file := own_file(photo)) is not None
        and not isinstance(photo, UndistortedPhoto)
        and (known := exif_focal(file, photo.size_hw)) is not None
    ]
    if ratios and not 1 / EXIF_FACTOR < (ratio := float(np.median(ratios))) < EXIF_FACTOR:
        logger.warning(
            "The EXIF data of the photos say a focal length %.2f times that of the result: if they are right, shapes "
            "are stretched along the view. Intrinsics that are known can be given with --cameras.",
            ratio,
        )


def _doubt_poses(fit: CameraFit, known: KnownCameras, scale: Scale | None) -> None:
    source = known.source
    if not fit.has_scale:
        count = "one known pose gives" if known.has_pose.sum() == 1 else "the known poses are all in one place and give"
        logger.warning("%s: %s no scale: depth keeps that of the prediction.", source, count)
    far = fit.position is not None and fit.position > DOUBTFUL_SHARE
    if fit.rotation_deg > DOUBTFUL_DEG or far:
        apart = "" if fit.position is None else f" and {fit.position:.0%} of the longest distance between them"
        logger.warning(
            "%s: the model sees other cameras than the known ones, by %.1f degrees%s in the median: its depth does not "
            "fit them. Check the cameras, or give more photos.",
            source, fit.rotation_deg, apart,
        )  # fmt: skip
    elif fit.spread is not None and fit.spread > DOUBTFUL_SPREAD:
        logger.warning(
            "%s: pairs of cameras give scales that differ by %.0f %%: the scale of depth is uncertain.",
            source, 100 * fit.spread,
        )  # fmt: skip
    factor = float(fit.sim3.s)
    if scale is not None and known.metric and fit.has_scale and not 0.8 < factor < 1.25:
        logger.warning(
            "%s: its metres are %.3g times those of the model. The cameras are believed; check their unit, and leave "
            "--metric out if it is not the metre.",
            source, factor,
        )  # fmt: skip


def _doubt_focal(focal: float, known: KnownCameras) -> None:
    if abs(focal - 1) > DOUBTFUL_FOCAL:
        logger.warning(
            "%s: the known focal lengths are %.2f times those that the model sees. The known ones are used, and depth "
            "keeps its shape, so that surfaces may be stretched along the view.",
            known.source, focal,
        )  # fmt: skip


def with_one_camera(
    prediction: Reconstruction, photos: Sequence[PhotoLike], known: KnownCameras | None = None
) -> tuple[Reconstruction, dict[str, Any]]:
    """Give photos of one camera one focal length: the median of those that the model predicts for them.

    Photos are of one camera when they have the same size and, where there are EXIF data, the same camera and focal
    length in these. Intrinsics that are known stay as they are, and depth stays.

    Returns:
        The reconstruction, and JSON-like facts: `cameras`, one entry for each with more than one photo (`photos`,
        `focal_px` in pixels of the photos, `spread`: relative, one standard deviation).
    """
    if not prediction.has_cameras:
        return prediction, {"cameras": []}
    K = prediction.cameras()[1].copy()
    groups: dict[tuple, list[int]] = {}
    for view, photo in enumerate(photos):
        if known is None or known.cameras[view].K is None:
            groups.setdefault((photo.size_hw, _exif_camera(photo)), []).append(view)
    shared = []
    for (size_hw, _), views in groups.items():
        if len(views) < 2:
            continue
        scale = prediction.scale_xy[views]
        focal = np.stack((K[views, 0, 0], K[views, 1, 1]), axis=1) / scale
        median, spread = np.median(focal, axis=0), float(np.log(focal).std(axis=0).mean())
        K[views, 0, 0], K[views, 1, 1] = (median * scale).T
        shared.append({"photos": len(views), "focal_px": float(np.sqrt(median.prod())), "spread": spread})
        logger.info(
            "one camera: %d photos of %d x %d share a focal length of %.1f px; the model's differ by %.1f %%",
            len(views), size_hw[1], size_hw[0], shared[-1]["focal_px"], 100 * spread,
        )  # fmt: skip
        if spread > DOUBTFUL_FOCAL:
            logger.warning(
                "one camera: the focal lengths that the model sees in %d photos differ by %.0f %%; if they were taken "
                "with a zoom or several cameras, give --no-one-camera.",
                len(views), 100 * spread,
            )  # fmt: skip
    return replace(prediction, K=K), {"cameras": shared}


def is_one_camera(photos: Sequence[PhotoLike]) -> bool:
    """Whether photos are taken for those of one camera when nobody says so: frames of a video are."""
    return all(isinstance(photo, VideoFrame) for photo in photos)


def _exif_camera(photo: PhotoLike) -> tuple[str, ...] | None:
    """Maker, model and focal lengths in a photo's EXIF data; None where there are none."""
    file = own_file(photo)
    if file is None:
        return None
    try:
        with opened(file) as image:
            exif = image.getexif()
            values = [*(exif.get(tag) for tag in _CAMERA_TAGS), *(exif.get_ifd(_EXIF).get(tag) for tag in _FOCAL_TAGS)]
    except (UnreadableImageError, OSError, SyntaxError, ValueError, TypeError, LookupError):
        return None
    return tuple(map(str, values)) if any(value is not None for value in values) else None


def undistorted_masks(masks: list[np.ndarray] | None, photos: Sequence[PhotoLike]) -> list[np.ndarray] | None:
    """Undistort the masks (H, W) of photos, nearest pixel, where the photos are undistorted."""
    if masks is None:
        return None
    return [
        _undistorted_mask(mask, photo) if isinstance(photo, UndistortedPhoto) else mask
        for mask, photo in zip(masks, photos, strict=True)
    ]


def _undistorted_mask(mask: np.ndarray, photo: UndistortedPhoto) -> np.ndarray:
    height, width = mask.shape
    v, u = np.mgrid[:height, :width]
    places = photo.to_original(np.stack((u.ravel() + HALF, v.ravel() + HALF), axis=1))
    column, row = np.floor(places).astype(np.int64).T
    return mask[row.clip(0, height - 1), column.clip(0, width - 1)].reshape(height, width)


def _poses(known: KnownCameras) -> Tensor:
    """Known poses, (n, 4, 4) float64."""
    found = [camera.T_cam_world for camera in known.cameras if camera.T_cam_world is not None]
    return torch.from_numpy(np.array(found, np.float64).reshape(-1, 4, 4))


def _or_identity(matrix: np.ndarray | None, size: int) -> Tensor:
    return torch.eye(size, dtype=torch.float64) if matrix is None else torch.from_numpy(np.asarray(matrix, np.float64))
