"""Compilers take `aggregate`, where an adaptation spends its time, as one graph."""

import pytest
import torch

from tiny_models import noise, same, tiny_da3, tiny_mapanything, tiny_pi3, tiny_vggt, trained


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Dynamo detected a call to a `functools.lru_cache`")
@pytest.mark.parametrize(
    ("make", "options"),
    [
        (tiny_da3, {"reference": "saddle_balanced"}),
        (tiny_vggt, {"layers": (0,)}),
        (tiny_pi3, {"layers": (0, 2)}),
        (tiny_mapanything, {"layers": (1,)}),
    ],
)
def test_aggregate_has_no_graph_break(make, options):
    model = make()
    trained(model)
    tokens = model.embed(noise(4)[None])
    torch.compiler.reset()
    compiled = torch.compile(lambda: model.aggregate(tokens, **options), backend="eager", fullgraph=True)
    found, expected = (
        [tensor for level in run().levels.values() for tensor in level]
        for run in (compiled, lambda: model.aggregate(tokens, **options))
    )
    assert same(found, expected)
    torch.autograd.backward([tensor.sum() for tensor in found if tensor.numel()])
    torch.compiler.reset()
