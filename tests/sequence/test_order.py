"""Descriptors rank frames by what they share, and photos in any order become a sequence of photos that are alike."""

from functools import cache

import numpy as np
import pytest
import torch

from freegeo.data.procedural import render, sample_rooms
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import co_visible
from freegeo.models.catalog import load_model
from freegeo.models.precision import Compute
from freegeo.sequence.order import descriptors, in_order, similarity_order
from tiny_models import noise, tiny_da3, tiny_mapanything, tiny_nested, tiny_single_view, tiny_vggt

FRAMES = 20


@pytest.fixture(autouse=True)
def always_one_thread(one_thread):
    """Every test of this file computes with one thread."""


@cache
def walk():
    """Views of a room's walk, and the share of their surface that each two of them have in common."""
    views = render(sample_rooms([30_000_021], domain="val-id", frames=FRAMES), 48, 64)
    ones = torch.ones(FRAMES, 2, dtype=torch.float64)
    scene = Candidate(
        T_cam_world=views.T_cam_world[0].double(), K=views.K[0].double(), depth_z=views.depth_z[0],
        scale_xy=ones, offset_xy=0 * ones,
    )  # fmt: skip
    share = co_visible(scene).share
    return views.images[0], np.minimum(share, share.T)


@cache
def described() -> np.ndarray:
    return descriptors(load_model("freegeo-tiny"), iter(walk()[0].split(7)), Compute())


def on_a_line(count: int, seed: int = 0) -> np.ndarray:
    """Descriptors of frames along a line: the farther apart, the less alike."""
    place = np.arange(count) / 4
    centres = np.linspace(place[0], place[-1], 2 * count)
    bumps = np.exp(-((place[:, None] - centres) ** 2))
    return (bumps / np.linalg.norm(bumps, axis=1, keepdims=True)).astype(np.float32)


def shuffled(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).permutation(count)


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt, tiny_mapanything, tiny_nested, tiny_single_view])
def test_every_model_describes_frames_by_unit_vectors(build):
    images = noise(3)
    found = descriptors(build(), [images[:2], images[2:]], Compute())
    assert found.shape == (3, 1024)
    assert found.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert found[0] @ found[1] < 1 - 1e-4


def test_a_descriptor_depends_on_its_frame_alone():
    model, images = tiny_da3(), noise(4)
    together = descriptors(model, [images], Compute())
    by_itself = descriptors(model, (image[None] for image in images.flip(0)), Compute())
    np.testing.assert_array_equal(together, by_itself[::-1])


def test_images_are_taken_when_their_turn_comes(monkeypatch):
    model, events = tiny_da3(), []
    embed = model.embed

    def parts():
        for number, image in enumerate(noise(3)):
            events.append(f"read {number}")
            yield image[None]

    def watched(images, layers):
        events.append("embed")
        return embed(images, layers=layers)

    monkeypatch.setattr(model, "embed", watched)
    descriptors(model, parts(), Compute())
    assert events == ["read 0", "embed", "read 1", "embed", "read 2", "embed"]


def test_half_precision_changes_a_descriptor_little():
    model, images = tiny_da3(), noise(3)
    exact, half = (descriptors(model, [images], Compute(precision=p)) for p in ("fp32", "bf16"))
    assert (exact * half).sum(-1).min() > 0.99


def test_no_frames_have_no_descriptors():
    assert descriptors(tiny_da3(), [], Compute()).shape == (0, 1024)


def test_likeness_follows_what_frames_share():
    similarity, share = described() @ described().T, walk()[1]
    i, j = np.triu_indices(FRAMES, 1)
    much, none = share[i, j] > 0.5, share[i, j] < 0.02
    assert much.sum() >= 10
    assert none.sum() >= 10
    right = similarity[i, j][much][:, None] > similarity[i, j][none]
    assert right.mean() > 0.97


def test_a_shuffled_walk_becomes_a_sequence_again():
    share = walk()[1]
    mixed = shuffled(FRAMES)
    order = mixed[similarity_order(described()[mixed])]
    given = share[np.arange(FRAMES - 1), np.arange(1, FRAMES)]
    found = share[order[:-1], order[1:]]
    assert found.mean() > 0.85 * given.mean()
    assert found.mean() > 2 * share[mixed[:-1], mixed[1:]].mean()


def test_a_walk_is_in_order_and_a_shuffled_one_is_not():
    assert in_order(described())
    assert in_order(described()[::-1])
    assert not any(in_order(described()[shuffled(FRAMES, seed)]) for seed in range(5))


def test_clips_one_after_the_other_are_in_order():
    clips = np.concatenate((described()[:7], described()[12:], described()[8:11]))
    assert in_order(clips)


@pytest.mark.parametrize("count", [3, 4, 12, 200])
def test_frames_along_a_line_come_back_exactly(count):
    line, mixed = on_a_line(count), shuffled(count)
    order = mixed[similarity_order(line[mixed])].tolist()
    assert order in (list(range(count)), list(range(count))[::-1])


def test_the_order_is_a_permutation_that_is_always_the_same():
    mixed = on_a_line(40)[shuffled(40)] + np.random.default_rng(0).normal(0, 0.05, (40, 80)).astype(np.float32)
    order = similarity_order(mixed)
    assert sorted(order) == list(range(40))
    assert order == similarity_order(mixed)
    assert order[0] < order[-1]


@pytest.mark.parametrize("count", [0, 1, 2, 3, 30])
def test_pictures_that_are_all_the_same_stay_as_they_are(count):
    same = np.tile(on_a_line(5)[0], (count, 1))
    assert in_order(same)
    assert sorted(similarity_order(same)) == list(range(count))
