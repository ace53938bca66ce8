"""DA3 reproduces recorded numbers; its reference rules, early layers, known cameras and rays behave as described."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

TESTS = Path(__file__).parents[1]
sys.path.append(str(TESTS))  # parity_da3.py is shared with the full parity run and lies beside this folder

from fixture_tools import relative_error  # noqa: E402
from freegeo.errors import UserError  # noqa: E402
from freegeo.geometry.rays import cameras_from_rays  # noqa: E402
from freegeo.geometry.se3 import normalise_poses  # noqa: E402
from freegeo.models import reference  # noqa: E402
from freegeo.models.priors import usable  # noqa: E402
from freegeo.types import Priors  # noqa: E402
from parity_da3 import build, cases  # noqa: E402

FOLDER = TESTS / "fixtures" / "da3"
RECORDED = dict(cases(FOLDER))


@pytest.fixture(scope="module")
def model():
    return build(FOLDER / "tiny-mlp")


@pytest.fixture(scope="module")
def tokens(model):
    images = torch.rand(2, 5, 3, 28, 42, generator=torch.Generator().manual_seed(4))
    with torch.no_grad():
        return model.embed(images)


def known_cameras() -> Priors:
    """Five cameras side by side that look the same way, of the two scenes of `tokens`."""
    T = torch.eye(4).repeat(2, 5, 1, 1)
    T[..., 0, 3] = torch.arange(5.0)
    return Priors(T_cam_world=T, K=torch.eye(3).repeat(2, 5, 1, 1) * 40)


def test_recorded_cases_are_found():
    assert len(RECORDED) == 20


@pytest.mark.parametrize("check", RECORDED.values(), ids=RECORDED.keys())
def test_recorded_case(check: Callable[[], float]):
    assert check() <= 1


@torch.no_grad()
@pytest.mark.parametrize("rule", reference.RULES)
def test_rule_puts_its_view_first_and_returns_input_order(model, tokens, rule):
    features = model.aggregate(tokens, reference=rule)
    order = model.view_order(tokens, rule)
    for k in range(2):
        views = list(range(5)) if order is None else order[k].tolist()
        assert sorted(views) == list(range(5))
        by_hand = model.aggregate(tokens.select(views), reference="first").select(
            torch.tensor(views).argsort().tolist()
        )
        for layer, (patch, special) in features.levels.items():
            assert relative_error(patch[k], by_hand.levels[layer][0][k]) <= 1e-5
            assert relative_error(special[k], by_hand.levels[layer][1][k]) <= 1e-5


@torch.no_grad()
def test_two_views_keep_the_first_as_reference(model, tokens):
    assert all(model.view_order(tokens.select([0, 1]), rule) is None for rule in reference.RULES)


@torch.no_grad()
def test_layer_before_the_views_mix_must_be_kept_by_embed(model):
    images = torch.rand(1, 2, 3, 28, 28, generator=torch.Generator().manual_seed(5))
    early = model.config.alt_start - 1
    features = model.aggregate(model.embed(images, layers=[early]), layers=[early])
    alone = model.aggregate(model.embed(images[:, [1]], layers=[early]), layers=[early])
    assert relative_error(features.levels[early][0][:, 1:], alone.levels[early][0]) <= 1e-5
    with pytest.raises(UserError, match=f"layer {early} was not kept"):
        model.aggregate(model.embed(images), layers=[early])


@torch.no_grad()
def test_known_cameras_replace_the_learned_tokens(model, tokens):
    plain, known = model.aggregate(tokens), model.aggregate(tokens, priors=known_cameras())
    last = max(plain.levels)
    assert relative_error(known.levels[last][0], plain.levels[last][0]) > 1e-4


@torch.no_grad()
def test_known_cameras_are_normalised_by_the_model(model, tokens):
    """World frame, unit and reference rule do not matter, also where the world is so far off that float32 fails."""
    priors = known_cameras()
    frame = torch.eye(4, dtype=torch.float64)
    frame[:3, 3] = torch.tensor([5e5, -5e6, 100.0])
    moved = priors.T_cam_world.double() @ frame
    moved[..., :3, 3] *= 30.0
    for other in (replace(priors, T_cam_world=moved), replace(priors, has_pose=torch.ones(5, dtype=torch.bool))):
        one, two = (model.aggregate(tokens, reference="middle", priors=p).levels for p in (priors, other))
        assert all(relative_error(two[layer][0], one[layer][0]) < 1e-4 for layer in one)


@torch.no_grad()
def test_priors_are_what_a_caller_would_normalise_and_encode(model, tokens):
    """To the bit: the benchmark's numbers with given cameras are made so."""
    priors = known_cameras()
    known = model.encode_cameras(normalise_poses(priors.T_cam_world), priors.K, tokens.image_hw)
    ours, by_hand = model.aggregate(tokens, priors=priors), model.mix(tokens, model.config.out_layers, None, known)
    assert all(torch.equal(ours.levels[layer][0], by_hand.levels[layer][0]) for layer in by_hand.levels)


@pytest.mark.parametrize("missing", [{"K": None}, {"T_cam_world": None}, {"has_pose": torch.arange(5) > 0}])
@torch.no_grad()
def test_a_part_of_the_cameras_is_refused(model, tokens, missing):
    priors = replace(known_cameras(), **missing)
    with pytest.raises(UserError, match="poses and intrinsics of all photos, or none"):
        model.aggregate(tokens, priors=priors)
    assert usable(priors, model.spec)[0] is None
    assert usable(known_cameras(), model.spec)[0] is not None


@torch.no_grad()
def test_cameras_of_rays_are_those_of_the_ray_map_and_the_same_every_time(model, tokens):
    features = model.aggregate(tokens)
    rays = model.decode(features, want=("rays",)).rays
    found, again = (model.decode(features, want=("depth", "ray_cameras")) for _ in range(2))
    T, K = cameras_from_rays(rays[..., :6], rays[..., 6], (28, 42), generator=torch.Generator().manual_seed(0))
    assert torch.equal(found.T_cam_world, T) and torch.equal(found.K, K)
    assert torch.equal(again.T_cam_world, T) and torch.equal(again.K, K)
    assert found.rays is None and found.depth_z.shape == (2, 5, 28, 42)
    assert relative_error(found.K, model.decode(features).K) > 1e-3
    with pytest.raises(UserError, match="one of both"):
        model.decode(features, want=("cameras", "ray_cameras"))


@torch.no_grad()
def test_rays_are_read_only_when_asked_for(model, tokens):
    features = model.aggregate(tokens)
    assert model.decode(features).rays is None
    found = model.decode(features, want=("rays",))
    assert found.rays.shape == (2, 5, 16, 24, 7)
    assert (found.rays[..., 6] > 1).all() and found.depth_z is None
