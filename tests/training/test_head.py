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
    steps = train_head(
        model,
        open_pool(small_config, state, tmp_path, "cpu"),
        small_config,
        minutes=0.03,
        progress=lambda step, terms: depth.append(terms["depth"]),
    )
    assert steps == len(depth) > 0
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert changed
    assert all(name.startswith("head.") for name in changed)
    assert not any(parameter.requires_grad for parameter in model.parameters())
