"""A run that was stopped goes on with the same command and ends with the same tensors."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from freegeo.adaptation import trainer
from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.recipe import released
from freegeo.adaptation.trainer import Engine, adapt
from freegeo.errors import UserError
from tiny_models import noise_scene, quick, same, tensors, tiny_da3, tiny_vggt

RUN = """
import sys, time, torch
sys.path[:0] = {path!r}
torch.set_num_threads(1)
from pathlib import Path
from freegeo.adaptation import trainer
from freegeo.adaptation.engine import Engine
from tiny_models import noise_scene, quick, tiny_da3
trainer.SAVE_EVERY_S = -1.0
model = tiny_da3()
def shown(progress):
    print(progress.step, flush=True)
    if progress.step == 5:
        time.sleep(60)
trainer.adapt(model, [noise_scene(9), noise_scene(5, seed=1)], quick(model, steps=8, batch=2, dropout=0.1),
              engine=Engine(cache_place="disk", cache_folder=Path({folder!r})), resume_in=Path({folder!r}),
              on_step=shown)
"""


def test_a_killed_process_s_run_ends_with_the_same_tensors(tmp_path):
    def run(**options):
        model = tiny_da3()
        recipe = quick(model, steps=8, batch=2, dropout=0.1)
        return adapt(model, [noise_scene(9), noise_scene(5, seed=1)], recipe, **options)

    path = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
    program = RUN.format(path=path, folder=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.strip() == "5":
                os.kill(process.pid, signal.SIGKILL)
                break
    assert [path for path in tmp_path.iterdir() if path.is_dir()]
    steps = []
    resumed = run(
        engine=Engine(cache_place="disk", cache_folder=tmp_path),
        resume_in=tmp_path,
        on_step=lambda progress: steps.append(progress.step),
    )
    whole = run()
    assert steps == [5, 6, 7]
    # What the killed process kept on disk is gone, too.
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]
    assert resumed.curve == whole.curve
    assert same(tensors(resumed), tensors(whole))


@pytest.mark.parametrize("changed", ["seed", "recipe", "scenes"])
def test_the_state_of_another_run_is_refused(changed, tmp_path, monkeypatch):
    monkeypatch.setattr(trainer, "SAVE_EVERY_S", -1.0)
    model = tiny_da3()
    recipe = quick(model, steps=2)
    adapt(model, [noise_scene(9)], recipe, resume_in=tmp_path).adapter.detach()
    options = {"scenes": [noise_scene(9)], "recipe": recipe, "seed": 42}
    options |= {
        "seed": {"seed": 1},
        "recipe": {"recipe": recipe.changed(lr=1.0)},
        "scenes": {"scenes": [noise_scene(8)]},
    }[changed]
    with pytest.raises(UserError, match="belongs to another run"):
        adapt(model, resume_in=tmp_path, **options)
    # The refusal leaves no adapter behind.
    Adapter.attach(model, rank=2, alpha=2, dropout=0.0, generator=torch.Generator())


def test_a_damaged_state_is_refused(tmp_path):
    (tmp_path / trainer.STATE_FILE).write_bytes(b"no tensors")
    model = tiny_da3()
    with pytest.raises(UserError, match="damaged state"):
        adapt(model, [noise_scene(9)], quick(model), resume_in=tmp_path)


def test_a_recipe_that_draws_anew_goes_on_to_the_same_end(tmp_path, monkeypatch):
    monkeypatch.setattr(trainer, "SAVE_EVERY_S", -1.0)

    def run(on_step=lambda progress: None, **options):
        recipe = released("released-vggt", "eth3d").changed(epochs=3, sets_per_scene=2, rank=2, batch=1)
        return adapt(tiny_vggt(), [noise_scene(9)], recipe, on_step=on_step, **options)

    def stop(progress):
        if progress.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(stop, resume_in=tmp_path)
    assert same(tensors(run(resume_in=tmp_path)), tensors(run()))
