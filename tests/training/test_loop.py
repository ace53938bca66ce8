import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from safetensors import safe_open

from freegeo.errors import FreeGeoError, UserError
from freegeo.files import read_json
from freegeo.models.catalog import load_model
from freegeo.training import loop, state
from freegeo.training.loop import LOG, train

pytestmark = pytest.mark.slow

KILLED_RUN = """
import os, signal, sys
from pathlib import Path
from freegeo.training import loop
from freegeo.training.config import LossWeights, TrainConfig
loop.SAVE_EVERY_S = 0.0
def progress(state):
    if state.step == 4:
        os.kill(os.getpid(), signal.SIGKILL)
loop.train({config}, Path(sys.argv[1]), progress=progress)
"""


def tensors(path):
    with safe_open(path, "pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


@pytest.fixture(scope="module")
def stopped_run(tmp_path_factory):
    """The folder of `whole_run` as it stood after the fourth step."""
    return tmp_path_factory.mktemp("stopped") / "run"


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory, small_config, stopped_run):
    """A run that was never stopped; read only."""
    folder = tmp_path_factory.mktemp("whole")

    def save_and_copy(now):
        patch.setattr(loop, "SAVE_EVERY_S", 0.0 if now.step == 3 else 120.0)
        if now.step == 4:
            shutil.copytree(folder, stopped_run)

    with pytest.MonkeyPatch.context() as patch:
        return train(small_config, folder, progress=save_and_copy)


def test_a_stopped_run_ends_with_the_same_tensors(small_config, whole_run, stopped_run):
    assert torch.load(stopped_run / state.NEWEST_FILE, weights_only=True)["step"] == 4
    assert not (stopped_run / loop.WEIGHTS).exists()
    expected, found = tensors(whole_run), tensors(train(small_config, stopped_run))
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[name], found[name]) for name in expected)


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_a_killed_run_ends_with_the_same_tensors(tmp_path, small_config, whole_run):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    code = KILLED_RUN.format(config=small_config)
    killed = subprocess.run([sys.executable, "-c", code, str(tmp_path / "killed")], env=environment, check=False)
    assert killed.returncode == -signal.SIGKILL
    saved = torch.load(tmp_path / "killed" / state.NEWEST_FILE, weights_only=True)
    assert 0 < saved["step"] <= 4
    weights = train(small_config, tmp_path / "killed")
    expected, found = tensors(whole_run), tensors(weights)
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[name], found[name]) for name in expected)


def test_a_larger_budget_goes_on_from_the_plateau(tmp_path, small_config, whole_run):
    folder = tmp_path / "larger"
    shutil.copytree(whole_run.parent, folder)
    plateau = torch.load(folder / state.PLATEAU_FILE, weights_only=True)
    assert 30 <= plateau["views"] < 40
    steps = []
    larger = replace(small_config, views=60)
    train(larger, folder, progress=lambda now: steps.append((now.step, now.seen)))
    # The steps after the plateau are taken again, now without the cool-down, and the new budget is used up.
    assert steps[0][0] == plateau["step"] + 1
    assert steps[-1][1] >= 60


def test_a_run_continues_another_one_with_rooms_and_rates_of_its_own(tmp_path, small_config, whole_run):
    saved = torch.load(whole_run.parent / state.NEWEST_FILE, weights_only=True)
    before = saved["step"], saved["views"]
    config = replace(small_config, views=60, first_room=6, peak=0.25, cooldown=1.0)
    steps = []
    folder = tmp_path / "next"
    train(config, folder, continue_from=whole_run.parent, progress=lambda now: steps.append((now.step, now.seen)))
    assert steps[0][0] == before[0] + 1 and before[1] < steps[0][1] <= before[1] + 4 and steps[-1][1] >= 60
    begun = replace(config, begin=before)
    assert read_json(folder / loop.CONFIG)["begin"] == list(begun.begin)
    assert begun.rate(begun.begin[1]) == 0.0 and begun.rate(60) == 0.0
    assert 0 < max(begun.rate(seen) for seen in range(begun.begin[1], 60)) <= 0.25
    first_shards = [tensors(run / "rooms" / "rooms-64-00000.safetensors") for run in (folder, whole_run.parent)]
    assert not torch.equal(first_shards[0]["images"], first_shards[1]["images"])
    # Without being told again, and wherever the other run is by now.
    resumed = []
    train(replace(config, views=64), folder, progress=lambda now: resumed.append(now.seen))
    assert 60 < resumed[0] <= 64 + 4


def test_a_run_continues_a_weight_file_at_its_steps_and_views(tmp_path, small_config, whole_run):
    weights = train(replace(small_config, views=60), tmp_path / "next", continue_from=whole_run, minutes=0.0)
    before, after = tensors(whole_run), tensors(weights)
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    with safe_open(whole_run, "pt") as file:
        begun = [int(file.metadata()[name]) for name in ("step", "views")]
    assert read_json(tmp_path / "next" / loop.CONFIG)["begin"] == begun


def test_mistakes_about_the_run_to_continue_are_named(tmp_path, small_config, whole_run):
    with pytest.raises(UserError, match="no run to continue"):
        train(small_config, tmp_path / "next", continue_from=tmp_path)
    with pytest.raises(UserError, match="continues no other"):
        train(small_config, whole_run.parent, continue_from=tmp_path)
    with pytest.raises(UserError, match="Ask for more"):
        train(replace(small_config, views=30), tmp_path / "next", continue_from=whole_run.parent)
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / state.NEWEST_FILE).write_bytes(b"PK\3\4 cut off")
    with pytest.raises(UserError, match="not a readable checkpoint"):
        train(small_config, tmp_path / "damaged")


@pytest.mark.parametrize(
    "name, value", [("views_per_step", 1), ("peak", 0.0), ("cooldown", 1.5), ("rooms", 0), ("first_room", -1)]
)
def test_settings_out_of_range_are_refused(small_config, name, value):
    with pytest.raises(UserError, match=f"cannot train with {name.replace('_', '-')} {value}"):
        replace(small_config, **{name: value})


def test_a_step_that_the_memory_does_not_hold_is_refused(tmp_path, small_config, monkeypatch):
    monkeypatch.setattr(loop, "host_available", lambda: 10**9)
    with pytest.raises(UserError, match=r"1024 views takes about 47.2 GB .* 1.0 GB are free. Give --views-per-step 10"):
        train(replace(small_config, side=96, views_per_step=1024), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_state_of_an_earlier_version_is_refused(tmp_path, small_config):
    torch.save({"model": {}, "counters": torch.zeros(4)}, tmp_path / state.RESTART_FILE)
    with pytest.raises(UserError, match=r"restart.pt: an earlier version of freegeo wrote this state"):
        train(small_config, tmp_path / "next", continue_from=tmp_path)
    assert not (tmp_path / "next" / state.START_FILE).exists()


def test_a_log_that_is_a_link_is_not_followed(tmp_path, small_config):
    out, outside = tmp_path / "out", tmp_path / "outside"
    out.mkdir()
    (out / LOG).symlink_to(outside)
    with pytest.raises(UserError, match=r"log\.jsonl: is a symbolic link"):
        train(small_config, out, minutes=0)
    assert not outside.exists()


def test_other_settings_need_another_folder(small_config, whole_run):
    with pytest.raises(UserError, match="another seed"):
        train(replace(small_config, seed=7), whole_run.parent)


def test_the_weight_file_is_a_checkpoint_of_the_embedded_model(whole_run):
    model = load_model("freegeo-tiny", checkpoint=whole_run)
    prediction = model.decode(model.aggregate(model.embed(torch.rand(1, 3, 3, 48, 64))))
    assert torch.isfinite(prediction.depth_z).all()
    assert torch.isfinite(prediction.T_cam_world).all()
    with safe_open(whole_run, "pt") as file:
        assert int(file.metadata()["views"]) >= 40
        assert int(file.metadata()["seconds"]) >= 0
    assert whole_run.stat().st_size < 20e6


def test_a_leg_stops_in_time_and_is_resumed(tmp_path, small_config):
    seen = []
    train(small_config, tmp_path / "legs", minutes=0.0, progress=lambda now: seen.append(now.step))
    assert not seen
    assert (tmp_path / "legs" / state.NEWEST_FILE).is_file()


def test_a_broken_loss_stops_before_the_step_and_is_named(tmp_path, small_config, monkeypatch):
    def broken(*arguments):
        return {"depth": torch.tensor(float("nan"), requires_grad=True), "rays": torch.tensor(1.0)}

    monkeypatch.setattr(loop, "objective", broken)
    with pytest.raises(FreeGeoError, match="training step 0: depth not finite"):
        train(small_config, tmp_path)
    assert not (tmp_path / loop.WEIGHTS).exists()


def test_a_step_that_is_not_finite_is_left_out_where_that_is_allowed(tmp_path, small_config, monkeypatch):
    calls = []

    def broken_once(*arguments):
        calls.append(None)
        terms = real(*arguments)
        return {name: value * float("nan") for name, value in terms.items()} if len(calls) == 2 else terms

    real = loop.objective
    monkeypatch.setattr(loop, "objective", broken_once)
    config = replace(small_config, broken_steps=1, views=16)
    weights = train(config, tmp_path / "once")
    assert all(torch.isfinite(value).all() for value in tensors(weights).values())
    last = json.loads((tmp_path / "once" / loop.LOG).read_text().splitlines()[-1])
    assert last["kind"] == "end" and last["broken_steps"] == 1
    monkeypatch.setattr(loop, "objective", lambda *given: {k: v * float("nan") for k, v in real(*given).items()})
    with pytest.raises(FreeGeoError, match="steps were not finite"):
        train(config, tmp_path / "always")


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_gradients_that_are_not_finite_count_as_zero(small_config, value):
    def weights_after(spoil):
        now = state.new_state(small_config)
        results = []
        for index in range(2):
            generator = torch.Generator().manual_seed(index)
            for parameter in now.parameters():
                parameter.grad = torch.randn(parameter.shape, generator=generator)
            if index == 1:
                spoil(now)
            results.append(bool(loop.apply_gradients(now, 1.0, small_config)))
        return results, [*(parameter.detach() for parameter in now.parameters()), *now.average.values()]

    def break_one(now):
        now.model.cam_dec.fc_t.weight.grad[0, 0] = float(value)

    def clear_all(now):
        for parameter in now.parameters():
            parameter.grad.zero_()

    broken, expected = weights_after(break_one), weights_after(clear_all)
    assert broken[0] == [True, False] and expected[0] == [True, True]
    assert all(torch.equal(one, two) for one, two in zip(broken[1], expected[1], strict=True))


def test_a_run_for_a_gpu_is_trained_within_its_time_and_started_from_half_precision(
    tmp_path, small_config, monkeypatch, caplog
):
    ticks = itertools.count()
    clock = SimpleNamespace(monotonic=lambda: next(ticks) / 10)
    monkeypatch.setattr(loop, "time", clock)
    config = replace(
        small_config, side=32, views=10**9, minutes=0.04, render_share=0.2, rooms_at_start=4, views_per_step=8,
        depth_views=2, broken_steps=1, pairs_until=10**9,
    )  # fmt: skip
    places = []
    weights = train(config, tmp_path / "run", progress=lambda now: places.append(loop.position(now, config)))
    assert places == sorted(places) and len(places) > 2
    assert "of 1000000000 views, so these weights have learned little" in caplog.text
    model = load_model("freegeo-tiny", checkpoint=weights)
    assert model.config.width == 192 and weights.stat().st_size < 14.5e6
    prediction = model.decode(model.aggregate(model.embed(torch.rand(1, 3, 3, 24, 32))))
    assert torch.isfinite(prediction.depth_z).all()
    (tmp_path / "run" / state.NEWEST_FILE).unlink()
    restart = torch.load(tmp_path / "run" / state.RESTART_FILE, weights_only=True)
    assert (tmp_path / "run" / state.RESTART_FILE).stat().st_size < 14.5e6
    begun = []

    def compare(now):
        begun.append(now.step)
        if len(begun) == 1:
            name = "backbone.pretrained.blocks.4.mlp.fc1.weight"
            kept = restart["model"][name].float()
            # A step at the very beginning of the warm-up hardly moves the weights.
            torch.testing.assert_close(now.model.state_dict()[name], kept, atol=2e-2, rtol=0)

    train(config, tmp_path / "next", continue_from=tmp_path / "run", progress=compare)
    assert begun[0] == restart["step"] + 1


def test_global_blocks_first_look_for_tokens_like_themselves(small_config):
    model = state.new_state(small_config).model
    backbone = model.backbone["pretrained"]
    for index, block in enumerate(backbone.blocks):
        query, key, _ = block.attn.qkv.weight.chunk(3)
        assert torch.equal(query, key) == backbone.is_global(index)


def test_a_fresh_model_stands_still_with_a_common_lens(small_config):
    model = state.new_state(small_config).model
    features = model.aggregate(model.embed(torch.rand(1, 3, 3, 48, 64)))
    encoding = model.cam_dec(features.levels[9][1][..., 0, :])
    expected = torch.tensor([0.0, 0, 0, 0, 0, 0, 1, state.FIRST_FOV_RAD, state.FIRST_FOV_RAD])
    torch.testing.assert_close(encoding, expected.expand(1, 3, 9))
    assert model.decode(features).depth_z.log().std() > 1e-3


def test_every_parameter_is_in_one_group_with_its_rate(small_config):
    built = state.new_state(small_config)
    groups = [group for optimiser in built.optimisers for group in optimiser.param_groups]
    listed = [parameter for group in groups for parameter in group["params"]]
    assert len(listed) == len({id(parameter) for parameter in listed}) == len(built.parameters())
    rates = {small_config.matrix_lr, small_config.other_lr, small_config.head_lr}
    assert {group[state.PLATEAU_LR] for group in groups} == rates
