"""Properties of the pose graph of chunks."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from freegeo.errors import FreeGeoError
from freegeo.geometry.sim3 import Sim3
from freegeo.sequence.alignment import Seam
from freegeo.sequence.graph import Edge, place

CHUNKS = 12
FALSE = torch.tensor([0, 1.5, 0, 1.0, 0, -0.7, 0.1], dtype=torch.float64)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def walk(seed=0, *, scales=True):
    """Chunks on a closed circle: from each chunk's own random frame to the world."""
    generator = torch.Generator().manual_seed(seed)
    spread = tensor(1, 1, 1, 2, 2, 2, 0.3 if scales else 0)
    places = []
    for k in range(CHUNKS):
        angle = 2 * math.pi * k / CHUNKS
        turned = Sim3.exp(tensor(0, angle, 0, 0, 0, 0, 0)).R
        standing = Sim3(s=tensor(1.0)[0], R=turned, t=2 * tensor(math.cos(angle), 0, math.sin(angle)))
        own = Sim3.exp(torch.randn(7, generator=generator, dtype=torch.float64) * spread)
        places.append(standing @ own)
    return places


def edge(world, first, second, error, *, robust=False, weight=0.9):
    """The true transform between two chunks, with an error about a place one unit before the second's first camera."""
    size = float(1 / world[second].s)
    centre = world[second].inverse().apply(world[second].t + tensor(0, 0, 1))
    local = Sim3(s=tensor(size)[0], R=torch.eye(3, dtype=torch.float64), t=centre)
    sim3 = world[first].inverse() @ world[second] @ local @ Sim3.exp(error) @ local.inverse()
    return Edge(first=first, second=second, sim3=sim3, weight=weight, robust=robust, centre=centre, size=size)


def chain(world, noise=0.02, seed=0, scales=True):
    generator = torch.Generator().manual_seed(seed)
    keep = tensor(1, 1, 1, 1, 1, 1, 1 if scales else 0)
    errors = noise * torch.randn((CHUNKS, 7), generator=generator, dtype=torch.float64) * keep
    return [edge(world, k, k + 1, errors[k]) for k in range(CHUNKS - 1)]


def error_of(placed, world):
    """Root mean square distance of the chunks' origins from the truth, in units of the world."""
    found = torch.stack([(world[0] @ sim3).t for sim3 in placed.sim3])
    return float((found - torch.stack([true.t for true in world])).square().sum(-1).mean().sqrt())


def difference(one, other):
    return max(float((a.inverse() @ b).log().abs().max()) for a, b in zip(one.sim3, other.sim3, strict=True))


NONE = torch.zeros(7, dtype=torch.float64)


def test_a_chain_is_its_seams_one_after_another():
    edges = chain(walk())
    placed = place(CHUNKS, edges)
    expected = Sim3.identity()
    for k, each in enumerate(edges):
        assert torch.equal(placed.sim3[k].t, expected.t)
        assert torch.equal(placed.sim3[k].R, expected.R)
        expected = expected @ each.sim3
    assert placed.pieces == [list(range(CHUNKS))]
    assert placed.residuals.max() < 1e-12
    assert (placed.trust == 1).all()


@pytest.mark.parametrize("scales", [True, False])
def test_a_true_loop_takes_drift_away(scales):
    world = walk(scales=scales)
    edges = chain(world, scales=scales)
    loop = edge(world, 0, CHUNKS - 1, NONE, robust=True)
    without, placed = (place(CHUNKS, some, fixed_scale=not scales) for some in (edges, [*edges, loop]))
    assert error_of(placed, world) < 0.6 * error_of(without, world)
    assert placed.trust[-1] > 0.9
    assert scales or all(abs(float(sim3.s) - 1) < 1e-12 for sim3 in placed.sim3)


def test_exact_edges_give_the_truth():
    world = walk()
    edges = chain(world, noise=0.0)
    placed = place(CHUNKS, [*edges, edge(world, 0, 11, NONE, robust=True), edge(world, 2, 7, NONE)])
    assert error_of(placed, world) < 1e-6
    assert placed.trust == pytest.approx(1)


def test_a_false_loop_changes_nothing():
    world = walk()
    edges = chain(world)
    false = edge(world, 2, 8, FALSE, robust=True)
    placed = place(CHUNKS, [*edges, false])
    assert placed.trust.tolist() == [1.0] * (CHUNKS - 1) + [0.0]
    assert placed.residuals[-1] > 1
    assert difference(placed, place(CHUNKS, edges)) < 1e-12
    trusted = place(CHUNKS, [*edges, edge(world, 2, 8, FALSE)])
    assert error_of(trusted, world) > 2 * error_of(placed, world)


def test_true_and_false_loops_are_told_apart():
    world = walk()
    edges = [*chain(world), edge(world, 0, CHUNKS - 1, NONE, robust=True)]
    false = [edge(world, 2, 8, FALSE, robust=True), edge(world, 1, 6, -FALSE, robust=True)]
    placed = place(CHUNKS, [*edges, *false])
    assert placed.trust[-3] > 0.9
    assert placed.trust[-2:].tolist() == [0, 0]
    assert difference(placed, place(CHUNKS, edges)) < 1e-5


def test_a_loop_chunk_with_one_false_end_joins_at_the_other():
    """A chunk of two places is a node; where its halves do not fit, one of its edges goes."""
    world = walk()
    edges = chain(world)[:-1]
    last = CHUNKS - 1
    placed = place(CHUNKS, [*edges, edge(world, 1, last, NONE, robust=True), edge(world, 7, last, FALSE, robust=True)])
    assert sorted(placed.trust[-2:].round(3).tolist()) == [0, 1]
    assert placed.pieces == [list(range(CHUNKS))]


@pytest.mark.slow
def test_the_order_of_edges_does_not_matter():
    world = walk()
    edges = [*chain(world), edge(world, 0, 11, NONE, robust=True), edge(world, 3, 9, 0.5 * FALSE, robust=True)]
    order = np.random.default_rng(0).permutation(len(edges))
    placed, other = place(CHUNKS, edges), place(CHUNKS, [edges[k] for k in order])
    assert difference(placed, other) < 1e-5
    assert other.trust == pytest.approx(placed.trust[order], abs=1e-5)


def looped():
    world = walk()
    return [*chain(world), edge(world, 0, CHUNKS - 1, 0.05 * torch.ones(7, dtype=torch.float64), robust=True)]


def test_frames_of_chunks_do_not_matter():
    """Each chunk in a new frame and unit, far from its contents too."""
    generator = torch.Generator().manual_seed(3)
    spread = tensor(1, 1, 1, 100, 100, 100, 1)
    new = [Sim3.exp(spread * torch.randn(7, generator=generator, dtype=torch.float64)) for _ in range(CHUNKS)]
    edges = looped()
    moved = [
        replace(
            each,
            sim3=new[each.first] @ each.sim3 @ new[each.second].inverse(),
            centre=new[each.second].apply(each.centre),
            size=each.size * float(new[each.second].s),
        )
        for each in edges
    ]
    placed, other = place(CHUNKS, edges), place(CHUNKS, moved)
    back = [new[0].inverse() @ sim3 @ own for sim3, own in zip(other.sim3, new, strict=True)]
    assert difference(placed, replace(other, sim3=back)) < 1e-5
    assert other.residuals == pytest.approx(placed.residuals, abs=1e-5)


def test_directions_of_edges_do_not_matter():
    edges = looped()
    turned = [
        replace(
            each,
            first=each.second,
            second=each.first,
            sim3=each.sim3.inverse(),
            centre=each.sim3.apply(each.centre),
            size=each.size * float(each.sim3.s),
        )
        for each in edges
    ]
    placed, other = place(CHUNKS, edges), place(CHUNKS, turned)
    assert difference(placed, other) < 1e-5
    assert other.trust == pytest.approx(placed.trust, abs=1e-5)


def test_the_first_chunk_stays():
    world = walk()
    placed = place(CHUNKS, [*chain(world), edge(world, 0, CHUNKS - 1, NONE)])
    assert torch.equal(placed.sim3[0].log(), NONE)


def test_a_heavier_edge_moves_less():
    world = walk()
    disagreeing = 0.1 * torch.ones(7, dtype=torch.float64)
    residuals = [
        place(2, [edge(world, 0, 1, NONE, weight=weight), edge(world, 0, 1, disagreeing, weight=0.5)]).residuals
        for weight in (0.5, 1.0)
    ]
    assert residuals[0][0] == pytest.approx(residuals[0][1], rel=0.05)
    assert residuals[1][0] == pytest.approx(residuals[1][1] / 2, rel=0.05)


def test_what_no_edge_connects_is_a_piece():
    world = walk()
    edges = [each for each in chain(world) if each.first not in (3, 8)]
    placed = place(CHUNKS, [*edges[::-1], edge(world, 4, 8, NONE)])
    assert placed.pieces == [[0, 1, 2, 3], [4, 5, 6, 7, 8], [9, 10, 11]]
    for piece in placed.pieces:
        assert torch.equal(placed.sim3[piece[0]].log(), NONE)
    alone = place(2, [])
    assert (alone.pieces, len(alone.residuals)) == ([[0], [1]], 0)


def test_edges_that_do_not_fit_are_errors():
    world = walk()
    with pytest.raises(FreeGeoError, match="does not fit 2 chunks"):
        place(2, [edge(world, 1, 2, NONE)])
    with pytest.raises(FreeGeoError, match="no weight"):
        place(2, [edge(world, 0, 1, NONE, weight=0.0)])


def test_a_seam_becomes_an_edge():
    seam = Seam(
        sim3=Sim3.identity(),
        frames=2,
        pixels=500,
        inliers=0.8,
        rms=0.02,
        centre=tensor(1, 2, 3),
        depth=4.0,
        by_matches=False,
        reason=None,
        doubt=None,
    )
    made = Edge.of(3, 4, seam, robust=True)
    assert (made.first, made.second, made.weight, made.size, made.robust) == (3, 4, 0.8, 4.0, True)
