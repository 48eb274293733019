"""Parameters and Adam's moments change together, whatever parameters there are."""

from typing import Any

import pytest
import torch

from random_gaussians import random_gaussians, stepped_optimizers
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.density import gaussian_ops
from thermosplat.training.density.gaussian_ops import (
    Optimizers,
    clear_moments,
    clone,
    grow,
    in_new_basis,
    opacities_restored,
    prune,
    reset_opacities,
)


def _snapshot(gaussians: Gaussians, optimizers: Optimizers) -> dict[str, dict[str, torch.Tensor]]:
    """Copies of every parameter and its moments."""
    result = {}
    for name, parameter in gaussians.named_parameters():
        state = optimizers[name].state[parameter]
        result[name] = {"value": parameter, "exp_avg": state["exp_avg"], "exp_avg_sq": state["exp_avg_sq"]}
    return {name: {key: value.detach().clone() for key, value in item.items()} for name, item in result.items()}


@pytest.mark.parametrize(
    "spectra", [{}, {"thermal": False}, {"others": {"nir": "own", "red_edge": "offset", "blue": "shared"}}]
)
def test_clone_appends_copies_with_fresh_moments(spectra: dict[str, Any]) -> None:
    """Clones follow the others, equal in every parameter, with zero moments."""
    gaussians = random_gaussians(6, **spectra)
    optimizers = stepped_optimizers(gaussians)
    before = _snapshot(gaussians, optimizers)
    selected = torch.tensor([False, True, False, False, True, False])
    clone(gaussians, optimizers, selected)
    assert len(gaussians) == 8
    for name, now in _snapshot(gaussians, optimizers).items():
        assert torch.equal(now["value"], torch.cat([before[name]["value"], before[name]["value"][selected]])), name
        for key in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(now[key][:6], before[name][key]), name
            assert not now[key][6:].any(), name


def test_growth_appends_copies_and_replaces_others_by_two_smaller_ones() -> None:
    """The halves are 1.6 times smaller, else copies; the original is gone; moments of all new ones are zero."""
    gaussians = random_gaussians(5)
    optimizers = stepped_optimizers(gaussians)
    before = _snapshot(gaussians, optimizers)
    cloned, halved = torch.tensor([False, True, False, False, False]), torch.tensor([True, False, False, True, False])
    rows = grow(gaussians, optimizers, cloned, halved, torch.Generator().manual_seed(0))
    assert len(gaussians) == 3 + 1 + 2 * 2
    assert rows.tolist() == [1, 2, 4, 1, 0, 3, 0, 3]
    for name, now in _snapshot(gaussians, optimizers).items():
        assert torch.equal(now["value"][:3], before[name]["value"][~halved]), name
        assert torch.equal(now["exp_avg"][:3], before[name]["exp_avg"][~halved]), name
        assert torch.equal(now["value"][3:4], before[name]["value"][cloned]), name
        assert not now["exp_avg"][3:].any(), name
        twice = torch.cat([before[name]["value"][halved]] * 2)
        if name == "log_scales":
            torch.testing.assert_close(now["value"][4:].exp(), twice.exp() / 1.6)
        elif name != "means":
            assert torch.equal(now["value"][4:], twice), name


def test_halves_are_drawn_from_the_gaussian() -> None:
    """Many splits of one Gaussian have its mean and its covariance."""
    gaussians = random_gaussians(1, thermal=False)
    with torch.no_grad():
        gaussians.log_scales.copy_(torch.tensor([[0.5, 0.1, 1.0]]).log())
        gaussians.means.fill_(2.0)
    w, x, y, z = torch.nn.functional.normalize(gaussians.quats[0].detach(), dim=0).tolist()
    rotation = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    covariance = rotation @ torch.diag(torch.tensor([0.25, 0.01, 1.0])) @ rotation.T
    many = Gaussians({name: p.detach().expand(20_000, *p.shape[1:]) for name, p in gaussians.named_parameters()})
    all_of_them = torch.ones(20_000, dtype=torch.bool)
    grow(many, fresh_optimizers(many), ~all_of_them, all_of_them, torch.Generator())
    means = many.means.detach()
    torch.testing.assert_close(means.mean(dim=0), torch.full((3,), 2.0), atol=0.02, rtol=0)
    torch.testing.assert_close(torch.cov(means.T), covariance, atol=0.02, rtol=0)


def fresh_optimizers(gaussians: Gaussians) -> Optimizers:
    """Optimizers before their first step: they have no state yet."""
    return {name: torch.optim.Adam([parameter]) for name, parameter in gaussians.named_parameters()}


def test_prune_removes_parameters_and_moments() -> None:
    """What stays keeps its moments."""
    gaussians = random_gaussians(6)
    optimizers = stepped_optimizers(gaussians)
    before = _snapshot(gaussians, optimizers)
    removed = torch.tensor([True, False, False, True, False, False])
    prune(gaussians, optimizers, removed)
    for name, now in _snapshot(gaussians, optimizers).items():
        for key in ("value", "exp_avg", "exp_avg_sq"):
            assert torch.equal(now[key], before[name][key][~removed]), name


@pytest.mark.parametrize("which", [torch.tensor([1, 3]), torch.tensor([False, True, False, True, False])])
@pytest.mark.parametrize("names", [None, ("logit_opacities",)])
def test_moments_of_some_are_cleared(which: torch.Tensor, names: tuple[str, ...] | None) -> None:
    """Adam forgets the named Gaussians, in all parameters or in the named ones alone; the parameters stay."""
    gaussians = random_gaussians(5)
    optimizers = stepped_optimizers(gaussians)
    before = _snapshot(gaussians, optimizers)
    clear_moments(gaussians, optimizers, which, names)
    for name, now in _snapshot(gaussians, optimizers).items():
        assert torch.equal(now["value"], before[name]["value"]), name
        for key in ("exp_avg", "exp_avg_sq"):
            expected = before[name][key]
            if names is None or name in names:
                expected[[1, 3]] = 0.0
            assert torch.equal(now[key], expected), name


def test_reset_lowers_both_opacities() -> None:
    """α and α_t are both at most the limit; what was fainter stays as it was, spectrum by spectrum."""
    gaussians = random_gaussians(200)
    optimizers = stepped_optimizers(gaussians)
    opacities, thermal = gaussians.opacities.detach(), gaussians.opacities_in("thermal").detach()
    assert (opacities > 0.01).any()
    assert ((opacities < 0.01) & (thermal > 0.01)).any()
    reset_opacities(gaussians, optimizers, 0.01)
    torch.testing.assert_close(gaussians.opacities, opacities.clamp(max=0.01))
    torch.testing.assert_close(gaussians.opacities_in("thermal"), thermal.clamp(max=0.01))
    for name in ("logit_opacities", "thermal_opacity_offsets"):
        state = optimizers[name].state[getattr(gaussians, name)]
        assert not state["exp_avg"].any()
        assert state["step"] == 1
    assert optimizers["means"].state[gaussians.means]["exp_avg"].any()


def test_reset_lowers_every_opacity() -> None:
    """Offsets and own logits of further spectra likewise, each by itself; a spectrum that shares α follows it."""
    gaussians = random_gaussians(200, others={"nir": "own", "red_edge": "offset"})
    optimizers = stepped_optimizers(gaussians)
    spectra = ("thermal", "nir", "red_edge", "blue")
    before = {name: gaussians.opacities_in(name).detach() for name in spectra}
    assert all((opacities > 0.01).any() and (opacities < 0.01).any() for opacities in before.values())
    reset_opacities(gaussians, optimizers, 0.01)
    for name, opacities in before.items():
        torch.testing.assert_close(gaussians.opacities_in(name), opacities.clamp(max=0.01))
    assert torch.equal(gaussians.opacities_in("blue"), gaussians.opacities)
    for name in ("logit_nir_opacities", "red_edge_opacity_offsets"):
        assert not optimizers[name].state[gaussians.get_parameter(name)]["exp_avg"].any()


def test_opacities_come_back_after_a_block() -> None:
    """Whatever a block does to opacities, of however many spectra, all are as before; other parameters are not."""
    gaussians = random_gaussians(5, others={"nir": "own"})
    before = {name: value.detach().clone() for name, value in gaussians.named_parameters()}
    with pytest.raises(KeyboardInterrupt), opacities_restored(gaussians), torch.no_grad():  # noqa: PT012
        for value in gaussians.parameters():
            value.zero_()
        raise KeyboardInterrupt
    changed = {name for name, value in gaussians.named_parameters() if not torch.equal(value, before[name])}
    opacities = {"logit_opacities", "thermal_opacity_offsets", "logit_nir_opacities"}
    assert changed == before.keys() - opacities


def test_vectors_in_a_new_basis() -> None:
    """Coordinates of vectors and of what Adam knows of their gradients; everything else stays what it was."""
    gaussians = random_gaussians(5)
    optimizers = stepped_optimizers(gaussians)
    before, features = _snapshot(gaussians, optimizers), gaussians.features
    basis = torch.linalg.qr(torch.randn(8, 3, generator=torch.Generator().manual_seed(3)))[0]
    in_new_basis(gaussians, optimizers, "features", 2.0 * basis, basis)
    now = _snapshot(gaussians, optimizers)
    old, new = before.pop("features"), now.pop("features")
    torch.testing.assert_close(new["value"], 2.0 * old["value"] @ basis)
    torch.testing.assert_close(new["exp_avg"], old["exp_avg"] @ basis)
    torch.testing.assert_close(new["exp_avg_sq"], old["exp_avg_sq"] @ basis.square())
    assert (new["exp_avg_sq"] > 0).all()
    assert all(torch.equal(now[name][key], before[name][key]) for name in before for key in before[name])
    assert features not in optimizers["features"].state
    gaussians.features.grad = torch.full_like(gaussians.features, 10.0)
    optimizers["features"].step()
    assert (gaussians.features < new["value"]).all()


def test_training_goes_on_after_every_operation() -> None:
    """The optimizers hold the new parameters, count their steps on, and move them."""
    gaussians = random_gaussians(4)
    optimizers = stepped_optimizers(gaussians)
    clone(gaussians, optimizers, torch.tensor([True, False, False, False]))
    first, second = torch.arange(5) == 0, torch.arange(5) == 1
    grow(gaussians, optimizers, first, second, torch.Generator())
    prune(gaussians, optimizers, torch.arange(7) == 0)
    reset_opacities(gaussians, optimizers, 0.01)
    for name, parameter in gaussians.named_parameters():
        before = parameter.detach().clone()
        parameter.grad = torch.full_like(parameter, 10.0)
        optimizers[name].step()
        assert (parameter < before).all(), name
        assert optimizers[name].state[parameter]["step"] == 2


def test_out_of_memory_leaves_the_gaussians_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    """An allocation that fails in the middle changes neither parameters nor moments."""
    gaussians = random_gaussians(6)
    optimizers = stepped_optimizers(gaussians)
    before = _snapshot(gaussians, optimizers)
    select, calls = torch.index_select, []

    def fail_late(*args: object, **kwargs: object) -> torch.Tensor:
        calls.append(1)
        if len(calls) == 8:
            raise torch.OutOfMemoryError
        return select(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(gaussian_ops.torch, "index_select", fail_late)
    with pytest.raises(torch.OutOfMemoryError):
        clone(gaussians, optimizers, torch.ones(6, dtype=torch.bool))
    monkeypatch.undo()
    for name, now in _snapshot(gaussians, optimizers).items():
        for key, value in now.items():
            assert torch.equal(value, before[name][key]), name
