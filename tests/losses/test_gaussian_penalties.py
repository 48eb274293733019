"""Penalties on opacities and scales."""

from typing import Literal

import pytest
import torch
from torch import Tensor

from thermosplat.config import LossConfig
from thermosplat.fused.gaussian_penalties import mean_opacity_and_scale
from thermosplat.losses.gaussian_penalties import gaussian_penalties
from thermosplat.scene.gaussians import Gaussians


def faint(opacity: float, thermal_opacity: float | None, scale: float) -> Gaussians:
    parameters = {
        "means": torch.zeros(2, 3),
        "log_scales": torch.full((2, 3), scale).log(),
        "logit_opacities": torch.logit(torch.full((2,), opacity)),
    }
    if thermal_opacity is not None:
        parameters["logit_thermal_opacities"] = torch.logit(torch.full((2,), thermal_opacity))
    return Gaussians(parameters)


BOTH = torch.ones(2, dtype=torch.bool)


def test_weighted_means_of_all_sets() -> None:
    """Each opacity there is counts by its mean; sets add up; scales count in scene extents."""
    config = LossConfig(opacity_reg=0.5, scale_reg=2.0)
    shared = gaussian_penalties({"shared": faint(0.2, 0.6, 0.1)}, config, 1.0, {"shared": BOTH})
    assert {name: term.item() for name, term in shared.items()} == pytest.approx({"opacity_reg": 0.4, "scale_reg": 0.2})
    sets = {"rgb": faint(0.2, None, 0.1), "thermal": faint(0.6, None, 0.3)}
    separate = gaussian_penalties(sets, config, 2.0, {"rgb": BOTH, "thermal": BOTH})
    assert separate["opacity_reg"].item() == pytest.approx(0.4)
    assert separate["scale_reg"].item() == pytest.approx(0.4)


def test_no_weight_no_term() -> None:
    """By default there is no penalty."""
    assert gaussian_penalties({"shared": faint(0.2, 0.6, 0.1)}, LossConfig(), 1.0, {"shared": BOTH}) == {}


def test_only_what_is_seen_fades() -> None:
    """Means are of the Gaussians that a step sees; others have no gradient; with none in view there is no penalty."""
    config = LossConfig(opacity_reg=1.0, scale_reg=1.0)
    gaussians = faint(0.2, 0.6, 0.1)
    with torch.no_grad():
        gaussians.logit_opacities[1], gaussians.log_scales[1] = 5.0, 3.0
    first = torch.tensor([True, False])
    found = gaussian_penalties({"shared": gaussians}, config, 1.0, {"shared": first})
    assert {name: term.item() for name, term in found.items()} == pytest.approx({"opacity_reg": 0.8, "scale_reg": 0.1})
    sum(found.values()).backward()
    for parameter in (gaussians.logit_opacities, gaussians.get_parameter("logit_thermal_opacities")):
        assert parameter.grad[0] > 0
        assert parameter.grad[1] == 0
    assert gaussians.log_scales.grad[1].abs().sum() == 0
    nobody = gaussian_penalties({"shared": gaussians}, config, 1.0, {"shared": ~BOTH})
    assert all(term.item() == 0 for term in nobody.values())


def test_shares_of_several_processes_add_up() -> None:
    """Divided by the number that all see, the penalties of two shares are those of the whole."""
    config, numbers = LossConfig(opacity_reg=1.0, scale_reg=1.0), {"shared": torch.tensor(3.0)}
    parts = [(faint(0.2, 0.6, 0.1), torch.tensor([True, False])), (faint(0.4, 0.3, 0.5), BOTH)]
    found = [gaussian_penalties({"shared": one}, config, 1.0, {"shared": seen}, numbers) for one, seen in parts]
    total = {name: sum(terms[name].item() for terms in found) for name in found[0]}
    assert total == pytest.approx({"opacity_reg": (0.8 + 2 * 0.7) / 3, "scale_reg": (0.1 + 2 * 0.5) / 3})


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("second", ["offsets", "own", "none"])
@pytest.mark.parametrize("count", [1, 77, 5000])
def test_same_as_torch(
    device: torch.device, count: int, second: Literal["offsets", "own", "none"], dtype: torch.dtype
) -> None:
    """Means and gradients against torch in float64, opacities of almost 0 and 1 among them."""
    generator = torch.Generator().manual_seed(count)
    drawn = [torch.randn(shape, generator=generator) for shape in ((count, 3), (count,), (count,))]
    drawn[1] *= 20.0

    def leaves(dtype: torch.dtype) -> list[Tensor]:
        return [tensor.to(device, dtype).requires_grad_() for tensor in drawn[: 2 if second == "none" else 3]]

    ours, exact = leaves(dtype), leaves(torch.float64)
    seen = torch.rand(count, generator=generator).to(device) < 0.7
    second_stored = None if second == "none" else ours[2]
    found = mean_opacity_and_scale(*ours[:2], second_stored, second == "offsets", seen, seen.sum())
    opacities = exact[1].sigmoid()
    if second != "none":
        opacities = opacities + (exact[2] + (exact[1] if second == "offsets" else 0.0)).sigmoid()
    number = seen.sum().clamp(min=1)
    expected = [opacities[seen].sum() / number, exact[0][seen].exp().mean(dim=1).sum() / number]
    slopes = torch.autograd.grad([found[0] * 0.7, found[1] * 3.0], ours)
    truth = torch.autograd.grad([expected[0] * 0.7, expected[1] * 3.0], exact)
    tolerance = 2e-6 if dtype is torch.float32 else 1e-14
    for value, reference in zip([*found, *slopes], [*expected, *truth], strict=True):
        assert value.dtype == dtype
        # a gradient is 1 / N of a value of order 1
        scale = 1.0 if value.dim() == 0 else 10.0 / count
        torch.testing.assert_close(value.double(), reference, rtol=tolerance, atol=tolerance * scale)


def test_every_opacity_counts() -> None:
    """A set with three opacities is penalised for the sum of their means, and every one of them is trained."""
    parameters = dict(faint(0.2, 0.6, 0.1).named_parameters())
    gaussians = Gaussians(parameters | {"nir_opacity_offsets": torch.full((2,), 1.0)})
    (penalty,) = gaussian_penalties({"shared": gaussians}, LossConfig(opacity_reg=1.0), 1.0, {"shared": BOTH}).values()
    nir = torch.sigmoid(torch.logit(torch.tensor(0.2)) + 1.0).item()
    assert penalty.item() == pytest.approx(0.2 + 0.6 + nir)
    penalty.backward()
    assert all(
        gaussians.get_parameter(name).grad.abs().min() > 0
        for name in ("logit_opacities", "logit_thermal_opacities", "nir_opacity_offsets")
    )
