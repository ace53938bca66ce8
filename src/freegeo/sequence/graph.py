"""Where every chunk lies, from all seams together: a pose graph of similarities.

docs/sequences.md, "Placing chunks", says what is minimised.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from freegeo.errors import FreeGeoError
from freegeo.geometry.se3 import camera_centres
from freegeo.geometry.sim3 import SHORT_PAIR, DegenerateAlignmentError, Sim3, fit_cameras
from freegeo.sequence.alignment import Seam

__all__ = ["LEAST_TRUST", "Edge", "Placed", "Sight", "place", "place_in_world"]

KERNEL = 0.1
"""Difference of a robust edge from the result that halves its weight."""
LEAST_TRUST = 0.2
"""A robust edge that keeps less of its weight is left out, for even a small pull bends a long chain."""
_WIDER = 10.0
_MOST_STEPS = 30
_MEDIANS = 2.0
"""Differences of known poses that halve their weight, in medians of all, where that is more than `KERNEL`."""
_ROUNDS, _SETTLED = 5, 0.9
_MOST_PAIRS, _MOST_JUDGES = 300, 100


@dataclass(frozen=True, kw_only=True)
class Edge:
    """A measured transform between two chunks."""

    first: int
    second: int
    sim3: Sim3
    """Maps points of `second` to `first`."""
    weight: float
    """How much it counts, above 0; the share of inliers of its seam."""
    robust: bool
    """It may be wrong (a loop), so that it loses its weight when the others contradict it."""
    centre: Tensor
    """Where (3,) it was measured, in the frame of `second`: disagreements are counted there."""
    size: float
    """Length in units of `second` that a shift is relative to, such as the median depth."""
    has_scale: bool = True
    """Whether a scale was measured; one known pose has none."""
    kernel: float = KERNEL
    """Difference from the result that halves the weight of a robust edge."""

    @classmethod
    def of(cls, first: int, second: int, seam: Seam, *, robust: bool = False) -> Edge:
        """Return the edge of a seam between two chunks."""
        return cls(
            first=first,
            second=second,
            sim3=seam.sim3,
            weight=seam.inliers,
            robust=robust,
            centre=seam.centre,
            size=seam.depth,
        )


@dataclass(frozen=True, kw_only=True)
class Placed:
    """Where the chunks lie."""

    sim3: list[Sim3]
    """Maps points of each chunk to the first chunk of its piece, float64."""
    pieces: list[list[int]]
    """Chunks that edges connect, ascending; the pieces ordered by their first chunk."""
    residuals: np.ndarray
    """(edges,) how far each edge is from the result: length of the logarithm of the difference, in which a radian, a
    shift by `Edge.size` and a factor of e count alike. NaN for an edge between two pieces."""
    trust: np.ndarray
    """(edges,) weight, 0 to 1, that a robust edge kept, 0 where it was left out; 1 for the others."""
    world: list[int] = field(default_factory=list)
    """The chunks that are in the world of known cameras, which are one of the pieces."""
    doubted: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    """(sights,) whether a known pose of a chunk in the world is too far from the result, and has no part in it."""


@dataclass(frozen=True, kw_only=True)
class Sight:
    """A photo of a chunk whose pose in the world of known cameras is known."""

    chunk: int
    frame: int
    """Of the photo."""
    predicted: Tensor
    """`T_cam_world` (4, 4) float64 in the frame of the chunk."""
    known: Tensor
    """`T_cam_world` (4, 4) float64 in the world of the known cameras."""
    depth: float
    """Median depth of the photo in units of the chunk."""

    def edge(self, scale: Tensor, kernel: float) -> Edge:
        """Return the edge from the world, which is 0, to the chunk, whose units are `scale` ones of the world."""
        R = self.known[:3, :3].mT @ self.predicted[:3, :3]
        centre = camera_centres(self.predicted)
        sim3 = Sim3(s=scale, R=R, t=camera_centres(self.known) - scale * (R @ centre))
        return Edge(
            first=0, second=self.chunk, sim3=sim3, weight=1.0, robust=True, centre=centre, size=self.depth,
            has_scale=False, kernel=kernel,
        )  # fmt: skip


def place(count: int, edges: Sequence[Edge], *, fixed_scale: bool = False) -> Placed:
    """Place chunks so that they agree with the edges between them.

    The first chunk of each piece stays. Without a cycle the edges are chained exactly. Otherwise the sum over edges of
    the squared logarithm of their difference from the result is minimised, with a Cauchy loss of each robust edge.
    Robust edges that the others contradict are left out, and the rest is placed without them.

    Args:
        count: number of chunks.
        edges: in any order, several between two chunks if need be.
        fixed_scale: all scales are 1 and stay so.

    Raises:
        FreeGeoError: an edge of a chunk that does not exist or with itself, or without a positive weight and size.
    """
    for edge in edges:
        if edge.first == edge.second or not (0 <= edge.first < count and 0 <= edge.second < count):
            raise FreeGeoError(f"An edge between chunks {edge.first} and {edge.second} does not fit {count} chunks.")
        if not (edge.weight > 0 and edge.size > 0):
            raise FreeGeoError(f"The edge between chunks {edge.first} and {edge.second} has no weight or no size.")
    placed, pieces = _chained(count, edges)
    for piece in pieces:
        own = [edge for edge in edges if edge.first in piece]
        if len(own) >= len(piece):
            moved = _refined([placed[chunk] for chunk in piece], _renumbered(own, piece), fixed_scale=fixed_scale)
            for chunk, sim3 in zip(piece, moved, strict=True):
                placed[chunk] = sim3
    if not edges:
        return Placed(sim3=placed, pieces=pieces, residuals=np.zeros(0), trust=np.zeros(0))
    graph = _Graph.of(edges)
    lengths = graph.lengths(placed)
    trust = graph.trust(lengths)
    kept = trust >= LEAST_TRUST
    if not kept.all():
        rest = place(count, [edge for edge, keep in zip(edges, kept, strict=True) if keep], fixed_scale=fixed_scale)
        piece_of = {chunk: number for number, piece in enumerate(rest.pieces) for chunk in piece}
        together = np.array([piece_of[edge.first] == piece_of[edge.second] for edge in edges])
        lengths = graph.lengths(rest.sim3)
        trust[kept], trust[~kept] = rest.trust, 0.0
        return replace(rest, residuals=np.where(together, lengths, np.nan), trust=trust)
    return Placed(sim3=placed, pieces=pieces, residuals=lengths, trust=trust)


def place_in_world(placed: Placed, edges: Sequence[Edge], sights: Sequence[Sight]) -> Placed:
    """Bring chunks into the world of the cameras of some photos, which stay where they are known to be.

    A piece with known poses in two places or more is brought there as it is, and then each pose is a robust edge to the
    world, and its seams give way. Lengths are those of the known cameras. Such pieces are one, others stay as they are.

    Args:
        placed: by `place` of the same edges.
        edges: the seams between the chunks.
        sights: photos with known poses; one that is in two chunks is two of them.
    """
    sim3, world, doubted = list(placed.sim3), [], np.zeros(len(sights), bool)
    trust, residuals = placed.trust.copy(), placed.residuals.copy()
    for piece in placed.pieces:
        seams = [k for k, edge in enumerate(edges) if edge.first in piece and trust[k] > 0]
        own = _renumbered([edges[k] for k in seams], [-1, *piece])
        here = [k for k, sight in enumerate(sights) if sight.chunk in piece]
        seen = [replace(sights[k], chunk=1 + piece.index(sights[k].chunk)) for k in here]
        found = _piece_in_world([sim3[chunk] for chunk in piece], own, seen)
        if found is None:
            continue
        world += piece
        moved, doubted[here] = found
        for chunk, place in zip(piece, moved[1:], strict=True):
            sim3[chunk] = place
        if own:
            graph = _Graph.of(own)
            residuals[seams] = graph.lengths(moved)
            after = graph.trust(residuals[seams])
            trust[seams] = np.where(after >= LEAST_TRUST, after, 0.0)
    pieces = [*(piece for piece in placed.pieces if piece[0] not in world), *([sorted(world)] if world else [])]
    return Placed(
        sim3=sim3, pieces=sorted(pieces), residuals=residuals, trust=trust, world=sorted(world), doubted=doubted
    )  # fmt: skip


def _piece_in_world(
    placed: Sequence[Sim3], seams: Sequence[Edge], sights: Sequence[Sight], *, all_believed: bool = False
) -> tuple[list[Sim3], np.ndarray] | None:
    """Place the chunks of one piece by its seams and known poses; chunks count from 1, and 0 is the world.

    The kernel of the poses follows their own median: how far a model's cameras are from the truth is not known.

    Returns:
        The world and the chunks, and for each sight whether it is left out; None without poses in two places.
    """
    fit = _fit_sights(placed, sights)
    if fit is None:
        return None
    # Of two poses that contradict each other none is known to be the wrong one.
    all_believed = all_believed or len({sight.frame for sight in sights}) == 2
    moved, kernel = [Sim3.identity(), *(fit @ sim3 for sim3 in placed)], math.inf

    def ties() -> list[Edge]:
        found = [sight.edge(moved[sight.chunk].s, kernel) for sight in sights]
        return [replace(tie, robust=False) for tie in found] if all_believed else found

    # The first round starts from where the seams put the chunks, and drift makes its kernel too wide.
    for _ in range(_ROUNDS):
        before, lengths = kernel, _Graph.of(ties()).lengths(moved)
        kernel = min(kernel, max(KERNEL, _MEDIANS * float(np.median(lengths))))
        if kernel > _SETTLED * before:
            break
        moved = _refined(moved, [*seams, *ties()], fixed_scale=False)
    tying = _Graph.of(ties())
    doubted = tying.trust(tying.lengths(moved)) < LEAST_TRUST
    if doubted.any():
        if _fit_sights(moved[1:], [sight for sight, out in zip(sights, doubted, strict=True) if not out]) is None:
            return _piece_in_world(placed, seams, sights, all_believed=True)
        believed = [tie for tie, out in zip(ties(), doubted, strict=True) if not out]
        moved = _refined(moved, [*seams, *believed], fixed_scale=False)
    return moved, doubted


def _fit_sights(placed: Sequence[Sim3], sights: Sequence[Sight]) -> Sim3 | None:
    """Bring a piece to the known poses of its photos by those two that leave the others nearest, in the median.

    The first of the chunks has number 1. None where the poses are not in two places, or the chunks have all of these
    photos in one.
    """
    if len(sights) < 2:
        return None
    seen = [placed[sight.chunk - 1] for sight in sights]
    predicted = torch.stack(
        [sim3.apply_to_cameras(one.predicted[None])[0] for sim3, one in zip(seen, sights, strict=True)]
    )
    known = torch.stack([one.known for one in sights])
    rng, judges = np.random.default_rng(0), list(sights)
    if len(sights) <= _MOST_JUDGES:
        pairs = rng.permutation(np.array(list(combinations(range(len(sights)), 2))))[:_MOST_PAIRS]
    else:
        pairs = rng.integers(len(sights), size=(_MOST_PAIRS, 2))
        judges = [sights[k] for k in rng.choice(len(sights), _MOST_JUDGES, replace=False)]
    centres = camera_centres(known)
    longest = float(torch.linalg.vector_norm(centres - centres.mean(0), dim=-1).max())
    best, least = None, math.inf
    for pair in pairs:
        if float(torch.linalg.vector_norm(centres[pair[0]] - centres[pair[1]])) <= SHORT_PAIR * longest:
            continue
        try:
            fit = fit_cameras(predicted[pair], known[pair])
        except DegenerateAlignmentError:
            continue
        moved = [fit.sim3 @ sim3 for sim3 in placed]
        ties = [one.edge(moved[one.chunk - 1].s, KERNEL) for one in judges]
        median = float(np.median(_Graph.of(ties).lengths([Sim3.identity(), *moved])))
        if median < least:
            best, least = fit.sim3, median
    return best


def _order(edge: Edge) -> tuple[bool, float, int, int]:
    """Sort sure edges before robust ones and heavy before light ones."""
    return edge.robust, -edge.weight, edge.first, edge.second


def _chained(count: int, edges: Sequence[Edge]) -> tuple[list[Sim3], list[list[int]]]:
    """Chain the edges of a maximum spanning tree (Kruskal) from the first chunk of each piece."""
    piece_of = list(range(count))
    neighbours: list[list[tuple[int, Sim3]]] = [[] for _ in range(count)]
    for edge in sorted(edges, key=_order):
        kept, joined = sorted((piece_of[edge.first], piece_of[edge.second]))
        if kept != joined:
            piece_of = [kept if piece == joined else piece for piece in piece_of]
            neighbours[edge.first].append((edge.second, edge.sim3))
            neighbours[edge.second].append((edge.first, edge.sim3.inverse()))
    placed: dict[int, Sim3] = {}
    for root in sorted(set(piece_of)):
        placed[root] = Sim3.identity()
        waiting = [root]
        while waiting:
            chunk = waiting.pop()
            for other, sim3 in neighbours[chunk]:
                if other not in placed:
                    placed[other] = placed[chunk] @ sim3
                    waiting.append(other)
    pieces = [[chunk for chunk in range(count) if piece_of[chunk] == root] for root in sorted(set(piece_of))]
    return [placed[chunk] for chunk in range(count)], pieces


def _renumbered(edges: Sequence[Edge], piece: Sequence[int]) -> list[Edge]:
    number = {chunk: i for i, chunk in enumerate(piece)}
    return [replace(edge, first=number[edge.first], second=number[edge.second]) for edge in edges]


@dataclass(frozen=True, kw_only=True)
class _Graph:
    """Edges as tensors (E, ...)."""

    first: Tensor
    second: Tensor
    measured: Sim3
    local: Sim3
    """From coordinates about the place of measurement, of its size, to the frame of the second chunk."""
    weight: Tensor
    robust: Tensor
    kernel: Tensor
    counted: Tensor
    """(E, 7): 1 for what was measured, 0 for a scale that was not."""

    @classmethod
    def of(cls, edges: Sequence[Edge]) -> _Graph:
        eye = torch.eye(3, dtype=torch.float64)
        return cls(
            first=torch.tensor([edge.first for edge in edges]),
            second=torch.tensor([edge.second for edge in edges]),
            measured=Sim3.stack([edge.sim3.to(torch.float64) for edge in edges]),
            local=Sim3(
                s=torch.tensor([edge.size for edge in edges], dtype=torch.float64),
                R=eye.expand(len(edges), 3, 3),
                t=torch.stack([edge.centre.double() for edge in edges]),
            ),
            weight=torch.tensor([edge.weight for edge in edges], dtype=torch.float64),
            robust=torch.tensor([edge.robust for edge in edges]),
            kernel=torch.tensor([edge.kernel for edge in edges], dtype=torch.float64),
            counted=torch.tensor([[1.0] * 6 + [float(edge.has_scale)] for edge in edges], dtype=torch.float64),
        )

    def ends(self, placed: Sim3) -> tuple[Sim3, Sim3]:
        """Where the two chunks of each edge lie."""
        return placed[self.first], placed[self.second]

    def differences(self, first: Sim3, second: Sim3) -> Tensor:
        """Logarithms (E, 7) of what each edge lacks to the places of its chunks, about its place of measurement."""
        lacking = (self.local.inverse() @ self.measured.inverse() @ first.inverse() @ second @ self.local).log()
        return self.counted * lacking

    def lengths(self, placed: Sequence[Sim3]) -> np.ndarray:
        """Lengths (E,) of the differences."""
        return torch.linalg.vector_norm(self.differences(*self.ends(Sim3.stack(placed))), dim=-1).numpy()

    def trust(self, lengths: np.ndarray) -> np.ndarray:
        """Weights (E,), 0 to 1, that robust edges keep with such differences; 1 for the others."""
        square = self.weight.numpy() * (lengths / self.kernel.numpy()) ** 2
        return np.where(self.robust.numpy(), 1 / (1 + square), 1.0)

    def errors(self, first: Sim3, second: Sim3, wider: float) -> Tensor:
        """Weighted differences (E, 7), of robust edges so much smaller that their square is the Cauchy loss.

        Kernels are `wider` than those of the edges by that factor.
        """
        weighted = self.weight.sqrt()[:, None] * self.differences(first, second)
        kernel = wider * self.kernel[:, None]
        square = weighted.square().sum(-1, keepdim=True).clamp(min=1e-300) / kernel**2
        return torch.where(self.robust[:, None], (square.log1p() / square).sqrt() * weighted, weighted)


def _refined(start: Sequence[Sim3], edges: Sequence[Edge], *, fixed_scale: bool) -> list[Sim3]:
    """Minimise the differences of the edges; the first of the placed chunks stays.

    With robust edges there are several minima. The search starts from the chain, where a true loop can look wrong, and
    from the minimum of a wide kernel, which every loop has pulled at; the lower of the two minima is taken.
    """
    from scipy.optimize import least_squares
    from scipy.sparse import csr_array

    graph, chain = _Graph.of(edges), Sim3.stack(start)
    about = _local_frames(len(start), graph)
    back, forth = about.inverse(), chain @ about
    free = 6 if fixed_scale else 7
    ends = torch.stack((graph.first, graph.second))

    def steps_of(x: np.ndarray) -> Tensor:
        steps = torch.zeros((len(start), 7), dtype=torch.float64)
        steps[1:, :free] = torch.from_numpy(x).reshape(-1, free)
        return steps

    def errors_after(steps: Tensor, wider: float) -> Tensor:
        first, second = (forth[chunks] @ Sim3.exp(own) @ back[chunks] for chunks, own in zip(ends, steps, strict=True))
        return graph.errors(first, second, wider)

    def errors(x: np.ndarray, wider: float) -> np.ndarray:
        return errors_after(steps_of(x)[ends], wider).flatten().numpy()

    def jacobian(x: np.ndarray, wider: float) -> csr_array:
        steps = steps_of(x)[ends].requires_grad_()
        columns = errors_after(steps, wider).sum(0)  # each edge has steps of its own, so the sum mixes nothing
        slopes = torch.stack([torch.autograd.grad(one, steps, retain_graph=True)[0] for one in columns])
        error, end, edge, step = (slopes != 0).nonzero(as_tuple=True)
        chunk = ends[end, edge]
        used = (chunk > 0) & (step < free)
        entries = slopes[error, end, edge, step][used].numpy()
        places = ((edge * 7 + error)[used].numpy(), ((chunk - 1) * free + step)[used].numpy())
        return csr_array((entries, places), shape=(7 * len(edges), x.size))

    def minimum(x: np.ndarray, wider: float = 1.0) -> tuple[float, np.ndarray]:
        # The inner solver must be exact: with its default tolerance a long chain takes hundreds of steps.
        exact = {"regularize": False, "atol": 1e-12, "btol": 1e-12, "maxiter": 20 * x.size}
        found = least_squares(
            errors, x, jac=jacobian, args=(wider,), ftol=1e-9, xtol=1e-9, gtol=1e-12,
            max_nfev=_MOST_STEPS, tr_options=exact,
        )  # fmt: skip
        return float(found.cost), found.x

    chained = np.zeros((len(start) - 1) * free)
    cost, best = minimum(chained)
    if bool(graph.robust.any()):
        other_cost, other = minimum(minimum(chained, _WIDER)[1])
        best = other if other_cost < cost else best
    moved = forth @ Sim3.exp(steps_of(best)) @ back
    return [start[0], *(moved[chunk] for chunk in range(1, len(start)))]


def _local_frames(count: int, graph: _Graph) -> Sim3:
    """For each chunk, coordinates about a place where one of its edges was measured, in the size of that place."""
    here = graph.measured @ graph.local
    frames: dict[int, tuple[Tensor, Tensor]] = {}
    for edge, (first, second) in enumerate(zip(graph.first.tolist(), graph.second.tolist(), strict=True)):
        frames.setdefault(second, (graph.local.s[edge], graph.local.t[edge]))
        frames.setdefault(first, (here.s[edge], here.t[edge]))
    s, t = (torch.stack([frames[chunk][part] for chunk in range(count)]) for part in (0, 1))
    return Sim3(s=s, R=torch.eye(3, dtype=torch.float64).expand(count, 3, 3), t=t)
