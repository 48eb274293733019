"""Warp's activations are torch's: values, gradients, and what is not finite."""

import pytest
import torch
from torch import Tensor

from thermosplat.fused.activations import activated

VARIANTS = ["offsets", "logit_thermal_opacities", None]
"""What the thermal opacity is made of; None: there is one opacity."""

TOLERANCES = {torch.float32: 5e-7, torch.float64: 1e-14}
"""A few units in the last place, of values and gradients of order 1."""


def plain(log_scales: Tensor, logits: Tensor, variant: str | None, second: Tensor) -> list[Tensor]:
    """Torch's own formulas."""
    visible = [torch.exp(log_scales), torch.sigmoid(logits)]
    if variant is None:
        return visible
    return [*visible, torch.sigmoid(logits + second if variant == "offsets" else second)]


def ours(log_scales: Tensor, logits: Tensor, variant: str | None, second: Tensor) -> list[Tensor]:
    """The kernel's results, without the one that there is not."""
    made = activated(log_scales, logits, None if variant is None else second, variant == "offsets")
    assert (made[2] is None) == (variant is None)
    return [tensor for tensor in made if tensor is not None]


def stored(count: int, dtype: torch.dtype, device: torch.device) -> list[Tensor]:
    """Leaves: log scales [N, 3], logits [N] and second numbers [N], which float32 holds exactly."""
    generator = torch.Generator().manual_seed(count)
    shapes = [(count, 3), (count,), (count,)]
    return [torch.randn(shape, generator=generator).to(device, dtype).requires_grad_() for shape in shapes]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("count", [0, 1, 77, 320])
def test_same_as_torch(device: torch.device, count: int, variant: str | None, dtype: torch.dtype) -> None:
    """Values and gradients against torch in float64, for no Gaussian, and for a last warp that is full or not."""
    leaves, exact = stored(count, dtype, device), stored(count, torch.float64, device)
    found, expected = ours(*leaves[:2], variant, leaves[2]), plain(*exact[:2], variant, exact[2])
    tolerance = {"rtol": TOLERANCES[dtype], "atol": TOLERANCES[dtype]}
    generator = torch.Generator().manual_seed(count + 1)
    upstream = [torch.randn(tensor.shape, generator=generator).to(tensor) for tensor in expected]
    truth = torch.autograd.grad(expected, exact[: len(expected)], upstream)
    slopes = torch.autograd.grad(found, leaves[: len(expected)], [v.to(dtype) for v in upstream])
    for value, reference in zip([*found, *slopes], [*expected, *truth], strict=True):
        assert value.dtype == dtype
        torch.testing.assert_close(value.double(), reference, **tolerance)


@pytest.mark.parametrize(
    ("variant", "alone"),
    [(variant, alone) for variant in VARIANTS for alone in range(2 if variant is None else 3)],
)
def test_gradient_of_one_result_alone(device: torch.device, variant: str | None, alone: int) -> None:
    """A loss of the scales alone, of α or of α_t: the others' gradients are zero."""
    leaves = stored(50, torch.float64, device)
    results = plain(*leaves[:2], variant, leaves[2])
    used = leaves[: len(results)]
    zeros = {"allow_unused": True, "materialize_grads": True}
    truth = torch.autograd.grad(results[alone].square().sum(), used, **zeros)
    slopes = torch.autograd.grad(ours(*leaves[:2], variant, leaves[2])[alone].square().sum(), used, **zeros)
    for value, reference in zip(slopes, truth, strict=True):
        torch.testing.assert_close(value, reference)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_numbers_of_any_size(device: torch.device, dtype: torch.dtype) -> None:
    """Finite logits have finite opacities and gradients; NaN and infinities give what torch gives, in their place."""
    finite = [0.0, -0.0, 1e-30, 17.0, -17.0, 80.0, -80.0, 100.0, -100.0, 800.0, -800.0, 1e30, -1e30]
    values = torch.tensor([*finite, torch.inf, -torch.inf, torch.nan], dtype=dtype, device=device)
    leaves = [values[:, None].repeat(1, 3).requires_grad_(), *(values.clone().requires_grad_() for _ in range(2))]
    found = ours(*leaves[:2], "logit_thermal_opacities", leaves[2])
    expected = plain(*leaves[:2], "logit_thermal_opacities", leaves[2])
    for value in found[1:]:
        assert value[: len(finite)].isfinite().all()
    slopes, truth = (
        torch.autograd.grad(results, leaves, [torch.ones_like(r) for r in results]) for results in (found, expected)
    )
    for value, reference in zip([*found, *slopes], [*expected, *truth], strict=True):
        # 1e-37: numbers below the normal ones may be zeros
        torch.testing.assert_close(value, reference, rtol=TOLERANCES[dtype], atol=1e-37, equal_nan=True)


def test_views_with_strides(device: torch.device) -> None:
    """Parts of wider tensors, and gradients that are one number for all."""
    table = torch.randn(40, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(device)
    table.requires_grad_()
    parts = table[:, :3], table[:, 3], "offsets", table[:, 5]
    slopes, truth = (
        torch.autograd.grad([r.sum() for r in results], table) for results in (ours(*parts), plain(*parts))
    )
    torch.testing.assert_close(slopes, truth)
