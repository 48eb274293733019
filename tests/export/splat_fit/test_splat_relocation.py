"""Splats that nobody sees move to where the error is."""

import dataclasses

import torch

from splat_scenes import scene_like_splats
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.splat_fit.splat_relocation import moves, relocate
from thermosplat.export.splat_rendering import render_splats
from thermosplat.export.splats import Splats


def one_splat_and_an_invisible_one(opacity: float) -> Splats:
    """A long splat that is turned, and one that nobody sees elsewhere."""
    return Splats(
        means=torch.tensor([[0.1, -0.2, 0.0], [9.0, 9.0, 9.0]]),
        quats=torch.tensor([[0.9, 0.1, 0.3, 0.4], [1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.log(torch.tensor([[0.2, 0.8, 0.1], [0.1, 0.1, 0.1]])),
        logit_opacities=torch.logit(torch.tensor([opacity, 1e-4])),
        sh0=torch.tensor([[[1.0, 0.2, -0.5]], [[0.0, 0.0, 0.0]]]),
        shN=torch.zeros(2, 0, 3),
    )


def test_halves_look_like_the_whole() -> None:
    """Two halves hide about what the whole did, at its place and in its colour."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = 6.0
    view = ViewTensors(viewmat, torch.tensor([[60.0, 0.0, 24.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]]), 48, 48)
    splats = one_splat_and_an_invisible_one(0.6)
    whole = render_splats(splats, view)
    relocate(splats, torch.tensor([1]), torch.tensor([0]))
    halves = render_splats(splats, view)
    assert whole.max() > 0.3
    assert (halves - whole).square().mean().sqrt() < 0.15 * whole.square().mean().sqrt()
    torch.testing.assert_close(halves.sum(), whole.sum(), rtol=0.1, atol=0)
    torch.testing.assert_close(splats.means.mean(dim=0), torch.tensor([0.1, -0.2, 0.0]), rtol=0, atol=1e-6)
    assert (splats.means[0] - splats.means[1]).norm() > 0.7  # the longest standard deviation


def test_second_moments_stay() -> None:
    """The halves' covariance and that of their centres sum to the covariance of the whole."""

    def covariance(splats: Splats, index: int) -> torch.Tensor:
        w, x, y, z = torch.nn.functional.normalize(splats.quats[index], dim=0)
        rotation = torch.stack(
            [
                torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
                torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
                torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
            ]
        )
        return rotation @ torch.diag(torch.exp(2 * splats.log_scales[index])) @ rotation.T

    splats = one_splat_and_an_invisible_one(0.99)
    whole, center = covariance(splats, 0), splats.means[0].clone()
    relocate(splats, torch.tensor([1]), torch.tensor([0]))
    offset = splats.means[0] - center
    torch.testing.assert_close(covariance(splats, 0) + torch.outer(offset, offset), whole, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(1 - (1 - torch.sigmoid(splats.logit_opacities)).prod(), torch.tensor(0.99))


def test_only_faint_splats_move_and_only_onto_errors() -> None:
    """Others stay, those without errors are not divided, and large errors are drawn more often."""
    splats = dataclasses.replace(scene_like_splats(400, 0))
    opacities = torch.full((400,), 0.5)
    opacities[:50], opacities[50:100] = 0.001, 0.01
    errors = torch.ones(400)
    errors[100:200], errors[200:300] = 0.0, 30.0
    generator = torch.Generator().manual_seed(0)
    moved, onto = moves(errors, torch.logit(opacities), generator)
    assert len(splats.means) == 400
    assert sorted(moved.tolist()) == list(range(100))
    assert len(set(onto.tolist())) == 100
    assert onto.min() >= 200
    assert ((onto >= 200) & (onto < 300)).sum() > 60


def test_the_faintest_move_where_not_all_can() -> None:
    """Half of those that can be divided are, at most."""
    opacities = torch.tensor([0.01, 0.5, 0.001, 0.5, 0.015])
    moved, onto = moves(torch.ones(5), torch.logit(opacities), torch.Generator().manual_seed(0))
    assert moved.tolist() == [2]
    assert onto.tolist() in ([1], [3])
