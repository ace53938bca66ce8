"""A plain adaptation step written from the equations: what speed and memory are compared with.

Two resident networks, nothing kept between steps, and every triplet formed explicitly in chunks of 64 references x 64
queries whose intermediate arrays are checkpointed. It computes the recipes `released-da3` and `released-vggt`
(docs/method.md, "Paper and released code").
"""

import copy

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.losses import StepDraws, TokenDraw, draw_tokens
from freegeo.adaptation.recipe import LossConfig, Recipe
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import Compute

CHUNK = 64
CPU = Compute()


def angle_chunk(p: Tensor, q: Tensor, tp: Tensor, tq: Tensor, k: Tensor, huber: bool) -> Tensor:
    """Sums (3,) of the penalties of all triplets of p (r, C), q (m, C), k (r, K, C): every difference is formed."""

    def cosines(p: Tensor, q: Tensor) -> list[Tensor]:
        p, q, anchor = p[:, None, None], q[None, None], k[:, :, None]
        pq, pk, qk = q - p, anchor - p, anchor - q
        pq, pk, qk = (F.normalize(edge, dim=-1, eps=1e-8) for edge in (pq, pk, qk))
        return [(pq * pk).sum(-1), (pk * qk).sum(-1), -(pq * qk).sum(-1)]

    with torch.no_grad():
        wanted = cosines(tp, tq)
    penalty = F.smooth_l1_loss if huber else F.l1_loss
    return torch.stack([penalty(f, w, reduction="sum") for f, w in zip(cosines(p, q), wanted, strict=True)])


def angle_loss(p: Tensor, q: Tensor, tp: Tensor, tq: Tensor, k: Tensor, *, huber: bool = False) -> Tensor:
    """Means (3,) over all R x K x m triplets: angles at p, k and q."""
    sums = [
        checkpoint(
            angle_chunk, p[i : i + CHUNK], q[j : j + CHUNK], tp[i : i + CHUNK], tq[j : j + CHUNK], k[i : i + CHUNK],
            huber, use_reentrant=False,
        )
        for i in range(0, len(p), CHUNK)
        for j in range(0, len(q), CHUNK)
    ]  # fmt: skip
    return torch.stack(sums).sum(0) / (k[..., 0].numel() * len(q))


def kl(found: Tensor, wanted: Tensor, config: LossConfig) -> Tensor:
    """Mean of SmoothL1 of KL(softmax(wanted / tau) || softmax(found / tau))."""
    log_found, log_wanted = ((d / config.temperature).log_softmax(-1) for d in (found, wanted))
    value = (log_wanted.exp() * (log_wanted - log_found)).sum(-1)
    return F.smooth_l1_loss(value, torch.zeros_like(value), beta=config.outer_beta)


def anchors(tokens: Tensor, held_out: Tensor, draw: TokenDraw, config: LossConfig) -> Tensor:
    """The K anchors (R, K, C) of every reference: half the most, half the least similar held-out tokens."""
    similarity = F.normalize(tokens[draw.reference], dim=-1) @ F.normalize(held_out, dim=-1).mT
    most = similarity.topk(config.num_anchors // 2).indices
    least = similarity.topk(config.num_anchors - config.num_anchors // 2, largest=False).indices
    return held_out[torch.cat([most, least], dim=-1)]


def chosen(tokens: Tensor, draw: TokenDraw) -> tuple[Tensor, Tensor]:
    """References (R, C) of the first view and queries (G, Q, C) of the others; tokens: (M, T, C)."""
    return tokens[0][draw.reference], tokens[1:].flatten(0, 1)[draw.query]


def relational(student: Tensor, teacher: Tensor, kept: tuple[int, ...], draws: StepDraws, config: LossConfig) -> Tensor:
    """The weighted cross loss; student (M, T, C), teacher (N, T, C) tokens of the last layer."""
    held_out = teacher[[view for view in range(len(teacher)) if view not in kept]].flatten(0, 1)
    kept_teacher = teacher[list(kept)]
    (p, q), (tp, tq) = chosen(student, draws.angle), chosen(kept_teacher, draws.angle)
    k = anchors(kept_teacher[0], held_out, draws.angle, config)
    weights = student.new_tensor(config.angle_weights)
    queries = q.flatten(0, 1), tq.flatten(0, 1)
    phi = angle_loss(p, queries[0], tp, queries[1], k, huber=config.angle_penalty == "huber")
    (p, q), (tp, tq) = chosen(student, draws.distance), chosen(kept_teacher, draws.distance)
    k = anchors(kept_teacher[0], held_out, draws.distance, config)
    pairs = min(p.shape[0], q.shape[1])
    kl_pq = kl(p[None, :pairs] - q[:, :pairs], tp[None, :pairs] - tq[:, :pairs], config)
    kl_pk = kl(p[:pairs, None] - k[:pairs], tp[:pairs, None] - k[:pairs], config)
    return (weights * phi).sum() + config.weight_pq * kl_pq + config.weight_pk * kl_pk


def intra(student: Tensor, teacher: Tensor, config: LossConfig) -> Tensor:
    """Huber and cosine between tokens of the kept views."""
    cosine = F.cosine_similarity(student, teacher, dim=-1).mean()
    return config.weight_huber * F.smooth_l1_loss(student, teacher) + config.weight_cosine * (1 - cosine)


class PlainAdaptation:
    """The loop's state: a teacher network, a student network with an adapter, an optimiser."""

    def __init__(self, model: ReconstructionModel, recipe: Recipe, seed: int, compute: Compute = CPU):
        self.recipe, self.seed, self.compute = recipe, seed, compute
        self.teacher = copy.deepcopy(model).eval()
        self.student = model
        self.adapter = Adapter.attach(
            model, rank=recipe.rank, alpha=recipe.alpha, dropout=recipe.dropout,
            generator=torch.Generator().manual_seed(seed),
        )  # fmt: skip
        self.optimiser = torch.optim.AdamW(self.adapter.parameters(), weight_decay=recipe.weight_decay)

    def step(self, step: int, images: Tensor, kept: tuple[int, ...], lr: float) -> float:
        """Take a step on one view set, images (N, 3, H, W); returns the loss."""
        config, layers = self.recipe.loss, self.student.spec.loss_layers
        images = images.to(self.compute.device)[None]
        with torch.no_grad(), self.compute.autocast():
            teacher = self.teacher.aggregate(self.teacher.embed(images, layers=layers), layers=layers).levels
        with torch.random.fork_rng(), self.compute.autocast():
            torch.manual_seed(self.seed * 1_000_003 + step)
            self.student.train()
            tokens = self.student.embed(images[:, list(kept)], layers=layers)
            student = self.student.aggregate(tokens, layers=layers).levels
            self.student.eval()
        every = config.cross_tokens == "all"
        student, teacher = (
            {
                i: (torch.cat([special, patch], 2) if every else patch)[0].float()
                for i, (patch, special) in levels.items()
            }
            for levels in (student, teacher)
        )
        draws = draw_tokens(
            config,
            tokens_per_view=student[layers[-1]].shape[1],
            student_views=len(kept),
            held_out=(images.shape[1] - len(kept)) * student[layers[-1]].shape[1],
            generator=torch.Generator().manual_seed(self.seed * 1_000_003 + step),
            device=images.device,
        )
        loss = torch.stack([intra(student[i], teacher[i][list(kept)], config) for i in layers]).mean()
        loss = loss + relational(student[layers[-1]], teacher[layers[-1]], kept, draws, config)
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.adapter.parameters(), self.recipe.clip)
        for group in self.optimiser.param_groups:
            group["lr"] = lr
        self.optimiser.step()
        return float(loss.detach())
