"""The last phase of a run: the dense head alone learns from every view, on features that stay as they are."""

from __future__ import annotations

from collections.abc import Callable

import torch

from freegeo.models.da3 import DA3
from freegeo.training.batches import Batch, draw_batch
from freegeo.training.config import TrainConfig
from freegeo.training.objective import Choice, depth_terms, ray_branch_term
from freegeo.training.pool import Pool
from freegeo.types import Features

LR = 8e-4
WARMUP_STEPS = 10


def train_head(
    model: DA3,
    pool: Pool,
    config: TrainConfig,
    *,
    progress: Callable[[int, dict[str, float]], None] = lambda step, terms: None,
) -> None:
    """Train the dense head in place for `head_steps` steps, the rate falling to zero.

    A step decodes all its views and needs no backward pass through the backbone, so depth gets several times as many
    examples for the same processor time as during the run, where the head sees `depth_views` views a step.
    """
    parameters = list(model.head.requires_grad_().parameters())
    device = parameters[0].device
    adamw = torch.optim.AdamW(parameters, lr=LR, weight_decay=0.01, fused=True)
    for step in range(config.head_steps):
        adamw.param_groups[0]["lr"] = LR * min(1.0, (step + 1) / WARMUP_STEPS) * (1 - step / config.head_steps)
        generator = torch.Generator().manual_seed(config.seed * 1_000_003 - 1 - step)
        batch = draw_batch(pool, config, config.views, generator, device)
        terms = head_terms(model, batch, config, step)
        adamw.zero_grad(set_to_none=True)
        torch.stack(list(terms.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(parameters, config.clip)
        adamw.step()
        progress(step + 1, {name: float(value.detach()) for name, value in terms.items()})
    model.head.requires_grad_(False)


def head_terms(model: DA3, batch: Batch, config: TrainConfig, step: int) -> dict[str, torch.Tensor]:
    """Return the depth terms of all views and now and then the term of the ray branch."""
    with torch.no_grad():
        features: Features = model.aggregate(model.embed(batch.images))
    terms = depth_terms(model, features, batch.depth_z, config)
    if step % config.ray_branch_every == 0:
        chosen = Choice(samples=torch.arange(len(batch.images)), view=step // config.ray_branch_every % 2)
        terms["ray_branch"] = config.weights.ray_branch * ray_branch_term(model, chosen.of(features), batch, chosen)
    return terms
