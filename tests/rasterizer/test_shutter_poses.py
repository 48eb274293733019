"""Motions between two poses, and poses half way, against plain torch."""

import pytest
import torch
from torch import Tensor

from gaussian_scenes import relative_error
from thermosplat.rasterizer.shutter_poses import motions


def reference(begin: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """The same by torch's own operations: the logarithm of a rotation, and the mean of two positions."""
    R0, t0, R1, t1 = begin[..., :3, :3], begin[..., :3, 3], end[..., :3, :3], end[..., :3, 3]
    Q = R1 @ R0.transpose(-1, -2)
    skew = (Q - Q.transpose(-1, -2)) / 2
    square = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1).square().sum(-1)
    cosine = (Q.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    small = square < 1e-8
    sine = torch.where(small, 1.0, square).sqrt()
    factor = torch.where(small, 1 + square / 6, torch.atan2(sine, cosine) / sine)
    W = factor[..., None, None] * skew
    A1 = W @ R0
    parts = [R0.flatten(-2), A1.flatten(-2), (W @ A1).flatten(-2), t0, t1 - t0, (factor.square() * square)[..., None]]
    positions = [-(R.transpose(-1, -2) @ t[..., None])[..., 0] for R, t in ((R0, t0), (R1, t1))]
    top = torch.cat([R0, -(R0 @ (sum(positions) / 2)[..., None])], -1)
    return torch.cat(parts, -1), torch.cat([top, begin[..., 3:, :]], -2)


def poses(angles: list[float]) -> tuple[Tensor, Tensor]:
    """Pairs [2, C, 4, 4] that turn by these angles [rad] about axes of their own."""
    generator = torch.Generator().manual_seed(3)

    def rotations(turn: Tensor) -> Tensor:
        x, y, z = turn.unbind(-1)
        zero = torch.zeros_like(x)
        return torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3)))

    shape = (2, len(angles), 3)
    begin, end = (torch.eye(4).double().repeat(2, len(angles), 1, 1) for _ in range(2))
    axes = torch.nn.functional.normalize(torch.randn(shape, generator=generator).double(), dim=-1)
    begin[..., :3, :3] = rotations(torch.randn(shape, generator=generator).double())
    end[..., :3, :3] = rotations(axes * torch.tensor(angles).double()[:, None]) @ begin[..., :3, :3]
    for pose in (begin, end):
        pose[..., :3, 3] = torch.randn(shape, generator=generator).double()
    return begin, end


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("asked", ["both", "motions", "views"])
def test_motions_and_their_gradients(device: torch.device, dtype: torch.dtype, asked: str) -> None:
    """No turn, tiny ones, and up to nearly half a turn; a batch of two; gradients to one output, or to both."""
    angles = [0.0, 1e-7, 9e-5, 1.1e-4, 0.01, 0.6, 2.9]
    given = [pose.to(dtype).double() for pose in poses(angles)]
    truth_in = [pose.clone().requires_grad_() for pose in given]
    ours_in = [pose.to(device, dtype).requires_grad_() for pose in given]
    truth, ours = reference(*truth_in), motions(*ours_in)
    tolerance = 1e-12 if dtype == torch.float64 else 2e-6
    assert all(torch.equal(x.double().cpu(), y) for x, y in zip(ours_in, given, strict=True))  # nobody wrote there
    for one, other in zip(ours, truth, strict=True):
        torch.testing.assert_close(one.double().cpu(), other.detach(), atol=tolerance, rtol=tolerance)
    weights = [torch.randn(x.shape, generator=torch.Generator().manual_seed(k)).double() for k, x in enumerate(truth)]
    chosen = {"both": (0, 1), "motions": (0,), "views": (1,)}[asked]
    losses = [sum((out[k] * weights[k].to(out[k])).sum() for k in chosen) for out in (truth, ours)]
    expected, found = (
        torch.autograd.grad(loss, leaves) for loss, leaves in zip(losses, (truth_in, ours_in), strict=True)
    )
    for one, other in zip(found, expected, strict=True):
        for c in range(len(angles)):  # each angle by itself
            assert relative_error(one[:, c].double().cpu(), other[:, c]) < (1e-9 if dtype == torch.float64 else 2e-5)


def test_poses_of_no_camera() -> None:
    """A batch without cameras has motions without rows, and gradients without any."""
    begin = torch.zeros(2, 0, 4, 4, requires_grad=True)
    made, views = motions(begin, torch.zeros(2, 0, 4, 4))
    (made.sum() + views.sum()).backward()
    assert made.shape[:2] == views.shape[:2] == (2, 0)
    assert begin.grad is not None
