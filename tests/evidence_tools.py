"""Exact matches of a generated room, and cameras with known errors."""

from dataclasses import replace

import numpy as np
import torch

from exact_rooms import room
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import co_visible
from freegeo.evidence.matches import Matches, Outcome
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.camera import project
from freegeo.geometry.depth import depth_to_world, unproject
from freegeo.geometry.se3 import camera_centres, from_Rt, relative, transform_points

VIEWS = 6


def truth(**options) -> Candidate:
    """The room with true cameras and depth."""
    return Candidate.of(room(views=VIEWS, hw=(72, 96), seed=5, **options))


def exact_matches(scene: Candidate, noise_px: float = 0.0, each: int = 40) -> Matches:
    """Matches of up to `each` visible points for every pair of views, with normal noise in photo pixels."""
    generator = np.random.default_rng(0)
    views, height, width = scene.depth_z.shape
    seen = co_visible(scene)
    photo_hw = np.rint(np.array([[height, width]]) / scene.scale_xy.numpy()[:, ::-1]).astype(np.int64)
    keypoints, ends, pairs = [[] for _ in range(views)], [], []
    for i, j in seen.pairs.tolist():
        pixels = seen.pixel[seen.seen[i, j]].numpy()
        if i > j or len(pixels) < each:
            continue
        chosen = torch.from_numpy(generator.choice(pixels, each, replace=False))
        point = unproject(scene.depth_z[i].double(), scene.K[i]).flatten(0, 1)[chosen]
        there = project(transform_points(relative(scene.T_cam_world[i], scene.T_cam_world[j]), point), scene.K[j])
        here = torch.stack((chosen % width, chosen // width), dim=-1).double()
        own = []
        for view, pixel in ((i, here), (j, there)):
            place = (pixel + 0.5 - scene.offset_xy[view]) / scene.scale_xy[view] - 0.5
            own.append(len(keypoints[view]) + np.arange(each))
            keypoints[view].extend(place.numpy() + generator.normal(0, noise_px, (each, 2)))
        pairs.append((i, j))
        ends.append(np.stack(own, axis=1))
    start = np.concatenate(([0], np.cumsum([len(k) for k in keypoints])))
    return Matches(
        names=tuple(f"photo {i}.JPG" for i in range(views)),
        photo_hw=photo_hw,
        match_hw=photo_hw,
        keypoints=np.concatenate([np.array(k).reshape(-1, 2) for k in keypoints]),
        view_start=start,
        pairs=np.array(pairs).reshape(-1, 2),
        pair_start=np.arange(len(pairs) + 1) * each,
        ends=np.concatenate([e + start[list(pair)] for e, pair in zip(ends, pairs, strict=True)]),
        flatness=np.zeros(len(pairs)),
        tried=np.array(pairs).reshape(-1, 2),
        outcome=np.full(len(pairs), int(Outcome.VERIFIED)),
        candidates=np.full(len(pairs), each),
        fingerprint="exact",
    )


def matched(
    scene: Reconstruction,
    *,
    noise_px: float = 0.3,
    points: int = 900,
    wrong: float = 0.0,
    joined=lambda i, j: True,
    seed: int = 0,
) -> Matches:
    """Matches of random surface points in all views that see them, with noise and a share of wrong ones."""
    generator = np.random.default_rng(seed)
    T, K = (torch.from_numpy(a).double() for a in scene.cameras())
    depth = torch.from_numpy(scene.depth_z).double()
    views, height, width = depth.shape
    world = depth_to_world(depth, K, T).reshape(-1, 3)
    world = world[torch.from_numpy(generator.choice(len(world), points, replace=False))]
    seen, places, row_of = np.zeros((views, points), bool), [], np.full((views, points), -1)
    for view in range(views):
        there = transform_points(T[view], world)
        pixel = project(there, K[view]).numpy()
        nearest = np.clip(np.rint(pixel), 0, (width - 1, height - 1)).astype(int)
        surface = depth[view].numpy()[nearest[:, 1], nearest[:, 0]]
        inside = (pixel > 0).all(axis=1) & (pixel < (width - 1, height - 1)).all(axis=1)
        seen[view] = inside & (there[:, 2].numpy() > 0) & (np.abs(there[:, 2].numpy() / surface - 1) < 0.03)
        row_of[view, seen[view]] = sum(len(p) for p in places) + np.arange(seen[view].sum())
        photo = (pixel[seen[view]] + 0.5 - scene.offset_xy[view]) / scene.scale_xy[view] - 0.5
        places.append(photo + generator.normal(0, noise_px, photo.shape))
    pairs, ends = [], []
    for i in range(views):
        for j in range(i + 1, views):
            both = np.flatnonzero(seen[i] & seen[j])
            if len(both) < 15 or not joined(i, j):
                continue
            second = both.copy()
            lie = generator.random(len(both)) < wrong
            second[lie] = generator.permutation(second[lie])
            pairs.append((i, j))
            ends.append(np.stack((row_of[i, both], row_of[j, second]), axis=1))
    return matches_of(scene, places, pairs, ends)


def matches_of(scene: Reconstruction, places: list, pairs: list, ends: list) -> Matches:
    count = len(pairs)
    return Matches(
        names=scene.names,
        photo_hw=scene.photo_hw,
        match_hw=scene.photo_hw,
        keypoints=np.concatenate(places),
        view_start=np.concatenate(([0], np.cumsum([len(p) for p in places]))),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        pair_start=np.concatenate(([0], np.cumsum([len(e) for e in ends]))).astype(np.int64),
        ends=np.concatenate(ends) if ends else np.zeros((0, 2), np.int64),
        flatness=np.zeros(count),
        tried=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        outcome=np.full(count, int(Outcome.VERIFIED)),
        candidates=np.array([len(e) for e in ends], dtype=np.int64),
        fingerprint="synthetic",
    )


def without_matches(matches: Matches, outcome: Outcome = Outcome.FEW_MATCHES) -> Matches:
    """The same photos where no pair was verified."""
    none = np.zeros((0, 2), np.int64)
    return replace(
        matches, pairs=none, ends=none, pair_start=np.zeros(1, np.int64), flatness=np.zeros(0),
        outcome=np.full(len(matches.tried), int(outcome)),
    )  # fmt: skip


def turned(T_cam_world: torch.Tensor, degrees: float, seed: int = 0) -> torch.Tensor:
    """Cameras (S, 4, 4) turned on the spot, each about its own random axis."""
    generator = torch.Generator().manual_seed(seed)
    axis = torch.randn(len(T_cam_world), 3, generator=generator, dtype=torch.float64)
    x, y, z = (axis / axis.norm(dim=1, keepdim=True) * np.deg2rad(degrees)).unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))
    R = torch.matrix_exp(skew) @ T_cam_world[:, :3, :3]
    return from_Rt(R, -(R @ camera_centres(T_cam_world)[..., None])[..., 0])


def moved_world(scene: Candidate, scale: float = 3.7) -> Candidate:
    """The same scene in another world frame, and larger."""
    frame = turned(torch.eye(4, dtype=torch.float64)[None], 70)[0]
    frame[:3, 3] = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    T = scene.T_cam_world @ frame
    T[:, :3, 3] *= scale
    return replace(scene, T_cam_world=T, depth_z=scene.depth_z * scale)
