import pytest
import torch

from freegeo.training.head import train_head
from freegeo.training.loop import open_pool
from freegeo.training.state import averaged, new_state


@pytest.mark.usefixtures("small_shards")
def test_only_the_dense_head_changes(tmp_path, small_config):
    state = new_state(small_config)
    model = averaged(state)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    depth = []
    pool = open_pool(small_config, state, tmp_path, "cpu")
    train_head(model, pool, small_config, progress=lambda step, terms: depth.append(terms["depth"]))
    assert len(depth) == small_config.head_steps
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert changed
    assert all(name.startswith("head.") for name in changed)
    assert not any(parameter.requires_grad for parameter in model.parameters())
