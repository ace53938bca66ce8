import pytest
import torch

from freegeo.training.muon import Muon, orthogonalise


@pytest.mark.parametrize("shape", [(128, 128), (512, 128), (128, 512), (24, 64)])
def test_singular_values_end_near_one_and_vectors_stay(shape):
    matrices = (
        torch.randn(3, *shape, generator=torch.Generator().manual_seed(0))
        * torch.tensor([1e-4, 1.0, 50.0])[:, None, None]
    )
    result = orthogonalise(matrices)
    singular = torch.linalg.svdvals(result)
    U, _, Vh = torch.linalg.svd(matrices, full_matrices=False)
    rotated = U.mT @ result @ Vh.mT
    if shape != (128, 128):  # a square random matrix has singular values next to zero, which stay small
        assert singular.min() > 0.4
    assert singular.max() < 1.6
    assert (rotated - torch.diag_embed(rotated.diagonal(dim1=-2, dim2=-1))).abs().max() < 1e-2


def test_most_of_a_square_matrix_is_orthogonalised():
    singular = torch.linalg.svdvals(orthogonalise(torch.randn(8, 128, 128, generator=torch.Generator().manual_seed(1))))
    assert (singular > 0.4).float().mean() > 0.97
    assert singular.max() < 1.6


def test_query_key_value_are_three_matrices():
    generator = torch.Generator().manual_seed(0)
    parameter = torch.nn.Parameter(torch.zeros(48, 16))
    parameter.grad = torch.cat([s * torch.randn(16, 16, generator=generator) for s in (1e-3, 1.0, 1e3)])
    Muon([parameter], lr=1.0, weight_decay=0.0).step()
    parts = parameter.detach().chunk(3)
    for part in parts:
        # Every part steps as far as an AdamW step of this learning rate, whatever its own gradient's size.
        assert part.pow(2).mean().sqrt() == pytest.approx(0.2, rel=0.35)


def test_momentum_remembers_and_decay_shrinks():
    parameter = torch.nn.Parameter(torch.eye(8))
    muon = Muon([parameter], lr=0.1, weight_decay=0.5)
    parameter.grad = torch.zeros(8, 8)
    muon.step()
    torch.testing.assert_close(parameter.detach(), 0.95 * torch.eye(8))
    parameter.grad = torch.eye(8)
    muon.step()
    torch.testing.assert_close(muon.state[parameter]["momentum"], 0.05 * torch.eye(8))
