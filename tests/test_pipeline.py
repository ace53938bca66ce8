"""The Python interface: what it takes, what it returns, and that it leaves the model as it was."""

import io
import logging
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import freegeo
from freegeo import pipeline
from freegeo.adaptation.adapter import Adapter, is_adapted
from freegeo.adaptation.recipe import PAPER
from freegeo.adaptation.state import UNFINISHED_FILE
from freegeo.errors import FreeGeoError, UserError
from freegeo.evidence.guard import State, states
from freegeo.export.reconstruction import Reconstruction
from freegeo.files import read_json
from freegeo.guarded import harm
from freegeo.models import api
from tiny_models import noise, quick, same, tensors, tiny_da3, trained

VIEWS, SIDE = 4, 32
QUICK = {"steps": 2, "sets": 2, "guard": "off"}


def pictures(views: int = VIEWS, seed: int = 0) -> list[np.ndarray]:
    return list((noise(views, seed).permute(0, 2, 3, 1) * 255).round().byte().numpy())


@pytest.fixture
def model():
    return tiny_da3()


@pytest.fixture
def saved(model, tmp_path):
    """A folder with an adapter that changes much; the model is as before."""
    from freegeo.adaptation.adapter_files import save_adapter

    adapter = trained(model)
    save_adapter(adapter, tmp_path / "adapter", {})
    adapter.detach()
    return tmp_path / "adapter"


def state(model) -> tuple[list[str], list[torch.Tensor], bool]:
    """What must be as before: names and values of everything on the model, and whether an adapter is on."""
    values = model.state_dict()
    return list(values), [value.clone() for value in values.values()], is_adapted(model)


def unchanged(model, before) -> bool:
    names, values, on = state(model)
    return names == before[0] and on == before[2] and same(values, before[1])


def close(one: Reconstruction, two: Reconstruction) -> bool:
    return np.allclose(one.depth_z, two.depth_z, atol=1e-5)


# -- reconstruct


def test_embedding_in_chunks_changes_nothing(model, monkeypatch):
    whole = freegeo.reconstruct(model, pictures(5), device="cpu")
    monkeypatch.setattr(api, "views_per_chunk", lambda device: 2)
    parts = freegeo.reconstruct(model, pictures(5), device="cpu")
    assert close(whole, parts)
    assert parts.names == tuple(f"image-{k:03d}" for k in range(5))
    assert whole.T_cam_world is not None and parts.T_cam_world is not None
    assert np.allclose(whole.T_cam_world, parts.T_cam_world, atol=1e-5)


def test_an_adapter_is_used_however_it_is_given(model, saved):
    frozen, before = freegeo.reconstruct(model, pictures()), state(model)
    adapted = freegeo.reconstruct(model, pictures(), adapter=str(saved))
    assert not close(frozen, adapted)
    assert unchanged(model, before)
    assert close(adapted, freegeo.reconstruct(model, pictures(), adapter=saved))

    adapter = freegeo.load_adapter(model, saved)
    attached = state(model)
    for given in (adapter, None):
        assert close(adapted, freegeo.reconstruct(model, pictures(), adapter=given))
        assert unchanged(model, attached)
    with adapter.off():
        off = state(model)
        assert close(frozen, freegeo.reconstruct(model, pictures()))
        assert close(adapted, freegeo.reconstruct(model, pictures(), adapter=adapter))
        assert unchanged(model, off)
    assert unchanged(model, attached)

    adapter.detach()
    assert close(frozen, freegeo.reconstruct(model, pictures()))
    assert close(adapted, freegeo.reconstruct(model, pictures(), adapter=adapter))
    assert unchanged(model, before)


def test_the_model_is_as_before_when_something_fails(model, saved):
    adapter = freegeo.load_adapter(model, saved)
    adapter.detach()
    before = state(model)
    for given in (adapter, saved):
        with pytest.raises(UserError, match="sideways"):
            freegeo.reconstruct(model, pictures(), adapter=given, reference="sideways")
        assert unchanged(model, before)


def test_results_with_and_without_an_adapter_have_the_same_reference_view(model, saved, monkeypatch):
    asked = []
    plain = model.aggregate
    monkeypatch.setattr(
        model, "aggregate", lambda tokens, **options: (asked.append(options["reference"]), plain(tokens, **options))[1]
    )
    model.spec = type(model.spec)(**{**vars(model.spec), "reference": "middle"})
    freegeo.reconstruct(model, pictures())
    freegeo.reconstruct(model, pictures(), adapter=saved)
    freegeo.reconstruct(model, pictures(), adapter=saved, reference="saddle_balanced")
    adapter = freegeo.load_adapter(model, saved)
    freegeo.reconstruct(model, pictures())
    with adapter.off():
        freegeo.reconstruct(model, pictures())
    assert asked == ["middle", "middle", "saddle_balanced", "middle", "middle"]


@pytest.mark.parametrize("broken", ["depth_z", "T_cam_world", "K"])
def test_an_answer_that_is_no_number_is_a_failure_of_the_model(model, monkeypatch, broken):
    plain = model.decode

    def decode(features, **options):
        found = plain(features, **options)
        value = getattr(found, broken).clone()
        value[:, 1] = float("nan")
        return replace(found, **{broken: value})

    monkeypatch.setattr(model, "decode", decode)
    with pytest.raises(FreeGeoError, match=rf"not a finite number for 1 of {VIEWS} views.*--precision fp32"):
        freegeo.reconstruct(model, pictures())


def test_a_few_values_that_are_no_numbers_are_no_failure(model, monkeypatch):
    plain = model.decode

    def decode(features, **options):
        found = plain(features, **options)
        depth_z = found.depth_z.clone()
        depth_z[..., 0, 0] = float("inf")
        return replace(found, depth_z=depth_z)

    monkeypatch.setattr(model, "decode", decode)
    result = freegeo.reconstruct(model, pictures())
    assert np.isinf(result.depth_z[:, 0, 0]).all()
    assert np.isfinite(result.depth_z[:, 1:]).all()


def test_adapters_that_cannot_be_used(model, saved, tmp_path):
    other = trained(tiny_da3(seed=1))
    with pytest.raises(UserError, match=r"Adapter\(tiny-da3, rank 4, on\) belongs to another model"):
        freegeo.reconstruct(model, pictures(), adapter=other)
    with pytest.raises(UserError, match="not an adapter folder"):
        freegeo.reconstruct(model, pictures(), adapter=tmp_path / "nothing")
    with pytest.raises(UserError, match="not dict"):
        freegeo.reconstruct(model, pictures(), adapter={})
    adapter = freegeo.load_adapter(model, saved)
    with pytest.raises(UserError, match="already carries an adapter; detach it first"):
        freegeo.reconstruct(model, pictures(), adapter=saved)
    adapter.merge()
    with pytest.raises(UserError, match="was merged"):
        freegeo.reconstruct(model, pictures(), adapter=adapter)


def test_a_model_is_asked_for_in_one_sentence(saved):
    for call in (freegeo.reconstruct, freegeo.adapt, freegeo.load_adapter):
        with pytest.raises(UserError, match=r"not str\. Load it with freegeo\.load_model\('da3-base'\)\.$"):
            call("da3-base", saved)
    with pytest.raises(UserError, match="not NoneType"):
        freegeo.reconstruct(None, pictures())


def test_photos_are_whatever_load_photos_takes(model, tmp_path):
    for k, pixels in enumerate(pictures()):
        Image.fromarray(pixels).save(tmp_path / f"{k}.png")
    wanted = freegeo.reconstruct(model, pictures())
    files = sorted(tmp_path.iterdir())
    images = [Image.open(file) for file in files]
    for given in (tmp_path, str(tmp_path), f"{tmp_path}/*.png", files, images, freegeo.load_photos(tmp_path)):
        assert close(wanted, freegeo.reconstruct(model, given))
    assert len(freegeo.reconstruct(model, tmp_path, max_views=2)) == 2
    with pytest.raises(UserError, match="no photos found"):
        freegeo.reconstruct(model, [])


def test_the_device_is_the_best_at_hand_unless_one_is_named(model, monkeypatch):
    asked = []
    monkeypatch.setattr(pipeline.Compute, "choose", lambda *wanted: (asked.append(wanted), pipeline.CPU)[1])
    freegeo.reconstruct(model, pictures())
    freegeo.adapt(model, pictures(), device="cpu", precision="fp32", **QUICK)
    assert asked == [(None, None), ("cpu", "fp32")]


# -- adapt


def test_adapting_keeps_the_adapter_on_until_it_is_detached(model):
    before = freegeo.reconstruct(model, pictures())
    result = freegeo.adapt(model, pictures(), guard="off", recipe=quick(model))
    assert len(result.curve) == 4
    after = freegeo.reconstruct(model, pictures())
    assert not close(before, after)
    with result.adapter.off():
        assert close(before, freegeo.reconstruct(model, pictures()))
    result.adapter.detach()
    assert close(before, freegeo.reconstruct(model, pictures()))
    result.adapter.reattach()
    assert close(after, freegeo.reconstruct(model, pictures()))


def test_settings_reach_the_recipe_as_on_the_command_line(model):
    result = freegeo.adapt(
        model, pictures(), guard="off", steps=3, sets=2, lr=1e-4, rank=2, hold=0.5, views=4, keep=[0, 2],
        loss={"weight_kq": 0.0, "num_query": 5}, seed=7,
    )  # fmt: skip
    recipe = result.recipe
    assert (recipe.name, recipe.steps, recipe.sets_per_scene, recipe.lr) == ("scene", 3, 2, 1e-4)
    assert (recipe.rank, recipe.alpha, recipe.hold, recipe.views, recipe.keep) == (2, 2, 0.5, 4, (0, 2))
    assert (recipe.loss.weight_kq, recipe.loss.num_query, recipe.loss.num_reference) == (0.0, 5, 256)
    assert result.seed == 7
    assert len(result.curve) == 3


def test_recipes_by_name_and_by_hand(model):
    named = freegeo.adapt(model, pictures(), guard="off", recipe="paper", dataset="eth3d", epochs=1, sets=1)
    assert (named.recipe.name, named.recipe.epochs, named.recipe.batch) == ("paper", 1, PAPER.batch)
    named.adapter.detach()
    for recipe, words in (("best", "unknown recipe 'best'"), (3, "not int"), ("paper", "choose --dataset")):
        with pytest.raises(UserError, match=words):
            freegeo.adapt(model, pictures(), guard="off", recipe=recipe)
    with pytest.raises(UserError, match="guard is select, report, off, not 'foo'"):
        freegeo.adapt(model, pictures(), guard="foo", recipe=quick(model))
    with pytest.raises(UserError, match="given by name"):
        freegeo.adapt(model, pictures(), guard="off", recipe=quick(model), dataset="eth3d")


def test_a_recipe_that_squashes_reads_the_photos_itself(model):
    plain = freegeo.adapt(model, pictures(), guard="off", recipe=quick(model))
    plain.adapter.detach()
    squashed = freegeo.adapt(model, pictures(), guard="off", recipe=quick(model, squash=16))
    assert not same(tensors(plain), tensors(squashed))


@pytest.mark.parametrize("views", [1, 2])
def test_too_few_photos_to_hold_one_out(model, views):
    with pytest.raises(UserError, match=f"needs at least 3 photos, got {views}"):
        freegeo.adapt(model, pictures(views))
    assert freegeo.reconstruct(model, pictures(views)).depth_z.shape == (views, SIDE, SIDE)


def test_a_run_that_was_stopped_continues(model, tmp_path):
    whole = freegeo.adapt(model, pictures(), guard="off", steps=4, sets=2)
    whole.adapter.detach()
    steps = []

    def stop(progress):
        steps.append(progress.step)
        if progress.step == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        freegeo.adapt(model, pictures(), guard="off", steps=4, sets=2, resume_in=str(tmp_path), on_step=stop)
    rest = freegeo.adapt(
        model, pictures(), guard="off", steps=4, sets=2, resume_in=tmp_path, on_step=lambda p: steps.append(p.step)
    )
    assert steps == [0, 1, 2, 3]
    assert same(tensors(whole), tensors(rest))
    rest.save(str(tmp_path))
    assert (tmp_path / "freegeo.json").is_file()
    assert not (tmp_path / UNFINISHED_FILE).exists()


def test_nothing_is_shown_unless_it_is_asked_for(model, monkeypatch):
    shown, steps = io.StringIO(), []
    # Commands that ran in this process have left their handler.
    monkeypatch.setattr(logging.getLogger("freegeo"), "handlers", [])
    with redirect_stdout(shown), redirect_stderr(shown):
        freegeo.adapt(model, pictures(), **QUICK).adapter.detach()
        freegeo.reconstruct(model, pictures())
        assert shown.getvalue() == ""
        freegeo.adapt(model, pictures(), progress=True, on_step=lambda p: steps.append(p.step), **QUICK)
    assert shown.getvalue().splitlines()[-1].startswith("adapting: 2/2")
    assert "loss " in shown.getvalue()
    assert steps == [0, 1]


# -- results


def test_results_describe_themselves_in_one_line(model, tmp_path):
    result = freegeo.adapt(model, pictures(), **QUICK)
    change = result.loss_change()
    expected = (
        f"Adapted(scene recipe, 2 steps, loss {change['first']:.4g} -> {change['last']:.4g}, {result.seconds:.0f} s)"
    )
    assert repr(result) == expected
    found = freegeo.reconstruct(model, pictures())
    assert repr(found) == f"Reconstruction({VIEWS} views, {SIDE} x {SIDE} pixels, cameras)"
    adapter: Adapter = result.adapter
    assert repr(adapter) == "Adapter(tiny-da3, rank 4, on)"
    adapter.set_strength(0.5)
    with adapter.off():
        assert repr(adapter) == "Adapter(tiny-da3, rank 4, off, strength 0.5)"
    adapter.detach()
    assert repr(adapter) == "Adapter(tiny-da3, rank 4, detached, strength 0.5)"
    adapter.merge()
    assert repr(adapter) == "Adapter(tiny-da3, rank 4, merged, strength 0.5)"


def test_results_are_stored_and_opened(model, tmp_path):
    found = freegeo.reconstruct(model, pictures())
    found.save(tmp_path)
    opened = freegeo.open_reconstruction(str(tmp_path))
    assert np.array_equal(opened.depth_z, found.depth_z)
    assert opened.names == found.names
    with pytest.raises(UserError, match="holds no reconstruction"):
        freegeo.open_reconstruction(tmp_path / "nowhere")


# -- guard


@pytest.fixture
def judged(monkeypatch):
    """Replaces the matches between photos by a verdict of choice; returns what is to be set and what was predicted."""
    from freegeo import guarded
    from freegeo.evidence.guard import Measurement, Trial, Verdict
    from freegeo.evidence.scores import PairScores

    nothing = PairScores(pairs=np.zeros((0, 2), np.int64), values=np.zeros(0), used=np.zeros(0, np.int64), reason="x")
    measured = Measurement(
        epipolar=nothing, reprojection=nothing, drift=0.0, agreement=1.0, agreement_before=1.0
    )  # fmt: skip
    told = {"state": None, "outcome": "frozen", "tried": []}

    def verdict(predict, references, **options):
        for state, found in zip(states(), predict(0, states()), strict=True):
            told["tried"].append((state, found.depth_z.clone()))
        chosen = None
        if told["state"] is not None:
            chosen = Trial(state=told["state"], measured=measured, gain=1.0, spread=0.1, probability=1.0, veto=None)
        trials = () if chosen is None else (chosen,)
        return Verdict(outcome=told["outcome"], reason="Because.", frozen=measured, trials=trials, chosen=chosen)

    monkeypatch.setattr(guarded, "try_states", verdict)
    return told


@pytest.mark.slow
@pytest.mark.parametrize("state", [(1.0, 1.0), (1.0, 0.5), (0.5, 1.0)])
def test_the_state_that_the_guard_chose_is_the_adapter(model, tmp_path, judged, state):
    judged |= {"state": State(steps=state[0], strength=state[1]), "outcome": "adapted"}
    result = freegeo.adapt(model, pictures(), steps=4, sets=2, lr=1e-2)
    expected = dict(judged["tried"])[judged["state"]].numpy()
    used = freegeo.reconstruct(model, pictures()).depth_z
    assert np.allclose(used, expected, atol=1e-6)
    assert len({round(float(depth.sum()), 4) for _, depth in judged["tried"]}) == 7
    assert result.verdict is not None and result.verdict["outcome"] == "adapted"
    assert result.verdict["reason"] == f"Because. It is used with {judged['state']}."
    result.save(tmp_path)
    result.adapter.detach()
    assert np.allclose(freegeo.reconstruct(model, pictures(), adapter=tmp_path).depth_z, used, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("outcome", ["frozen", "unknown"])
def test_an_adapter_that_the_guard_refuses_has_no_strength(model, judged, outcome):
    before = freegeo.reconstruct(model, pictures())
    judged["outcome"] = outcome
    result = freegeo.adapt(model, pictures(), steps=4, sets=2, lr=1e-2)
    assert close(freegeo.reconstruct(model, pictures()), before)
    assert result.verdict is not None and result.verdict["reason"] == "Because. The frozen model is used."
    result.adapter.set_strength(1.0)
    assert not close(freegeo.reconstruct(model, pictures()), before)


@pytest.mark.slow
def test_a_guard_that_reports_changes_nothing(model, judged):
    result = freegeo.adapt(model, pictures(), steps=4, sets=2, lr=1e-2, guard="report")
    reported = tensors(result)
    result.adapter.detach()
    plain = freegeo.adapt(model, pictures(), steps=4, sets=2, lr=1e-2, guard="off")
    assert result.verdict is not None and plain.verdict is None
    assert result.verdict["reason"] == "Because. The adapter is used as it was trained (--guard report)."
    assert result.adapter.strength == 1
    assert same(reported, tensors(plain))


@pytest.mark.slow
def test_states_on_the_way_outlive_a_stop(model, tmp_path, judged):
    def stop(progress):
        if progress.step == 2:
            raise KeyboardInterrupt

    settings = {"steps": 4, "sets": 2, "lr": 1e-2}
    with pytest.raises(KeyboardInterrupt):
        freegeo.adapt(model, pictures(), **settings, resume_in=tmp_path, on_step=stop)
    rest = freegeo.adapt(model, pictures(), **settings, resume_in=tmp_path)
    continued = judged["tried"].copy()
    rest.adapter.detach()
    judged["tried"].clear()
    freegeo.adapt(model, pictures(), **settings)
    for (state, one), (other, two) in zip(continued, judged["tried"], strict=True):
        assert state == other
        assert torch.equal(one, two)


# -- what is used in no mode


def walked(found: Reconstruction) -> Reconstruction:
    """The prediction with cameras that are apart; those of random weights are in one place."""
    T = found.T_cam_world.copy()
    T[:, 0, 3] += np.linspace(0, 3, VIEWS, dtype=np.float32)
    return replace(found, T_cam_world=T)


def in_one_place(found: Reconstruction) -> Reconstruction:
    return replace(found, T_cam_world=np.tile(found.T_cam_world[:1], (VIEWS, 1, 1)))


def with_little_depth(found: Reconstruction) -> Reconstruction:
    return replace(found, depth_z=np.where(np.arange(SIDE) < 0.6 * SIDE, np.nan, found.depth_z).astype(np.float32))


@pytest.mark.parametrize(
    ("guard", "broken", "words"),
    [
        ("off", in_one_place, "the cameras collapse"),
        ("report", in_one_place, "the cameras collapse"),
        ("off", lambda found: replace(found, depth_z=found.depth_z / 9), "drift apart in scale"),
        ("off", with_little_depth, "of the pixels with usable depth are left"),
        ("off", lambda found: replace(found, K=np.full_like(found.K, np.nan)), "not a finite number"),
    ],
)
def test_broken_predictions_are_trouble_in_any_mode(model, tmp_path, monkeypatch, caplog, guard, broken, words):
    plain = pipeline.predict_unchecked

    def predicted(model, batch, **options):
        found = walked(plain(model, batch, **options))
        return broken(found) if is_adapted(model) else found

    monkeypatch.setattr(pipeline, "predict_unchecked", predicted)
    result = freegeo.adapt(model, pictures(), steps=3, sets=2, lr=1e-3, guard=guard)
    assert result.trouble is not None and words in result.trouble and "Lower --lr (now 0.001)" in result.trouble
    assert result.verdict is None
    assert words in caplog.text
    result.save(tmp_path)
    assert words in read_json(tmp_path / "freegeo.json")["trouble"]


def test_photos_that_cannot_be_predicted_together_cost_no_adapter(model, monkeypatch, caplog):
    def too_large(*arguments, **options):
        raise UserError("too large")

    monkeypatch.setattr(pipeline, "plan_reconstruction", too_large)
    assert freegeo.adapt(model, pictures(), steps=3, sets=2, lr=1e-3, guard="off").trouble is None
    assert "Nobody looked at what the adapter does to predictions: too large" in caplog.text


@pytest.mark.parametrize("guard", ["select", "report"])
def test_photos_that_cannot_be_judged_together_are_refused_before_training(model, monkeypatch, guard):
    def too_large(*arguments, **options):
        raise UserError("too large")

    monkeypatch.setattr(pipeline, "plan_reconstruction", too_large)
    steps = []
    with pytest.raises(UserError, match="too large"):
        freegeo.adapt(model, pictures(), steps=3, sets=2, guard=guard, on_step=steps.append)
    assert not steps


def test_predictions_that_differ_by_frame_scale_and_little_else_are_no_harm(model):
    found = walked(freegeo.reconstruct(model, pictures()))
    T = found.T_cam_world
    larger = T.copy()
    larger[:, :3, 3] *= 5
    assert harm(found, replace(found, T_cam_world=larger, depth_z=5 * found.depth_z)) is None
    nearer = T.copy()
    nearer[:, :3, 3] *= 0.6
    assert harm(found, replace(found, T_cam_world=nearer)) is None
    # Photos from one place stay photos from one place, whatever noise their positions have.
    still = np.tile(np.eye(4, dtype=np.float32), (VIEWS, 1, 1))
    noisy = still.copy()
    noisy[:, 0, 3] = 0.02 * found.depth_z.mean() * np.arange(VIEWS) / VIEWS
    assert harm(replace(found, T_cam_world=still), replace(found, T_cam_world=noisy)) is None
    blind = replace(found, T_cam_world=None, K=None)
    assert harm(blind, blind) is None
