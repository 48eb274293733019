"""Gaussians that the spectra pull apart are divided between them."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from thermosplat.config import DensificationConfig, OptimizerConfig
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.density import decomposition
from thermosplat.training.density.decomposition import DecomposingStrategy
from thermosplat.training.density.gaussian_ops import Optimizers
from thermosplat.training.density.gradient_control import DefaultStrategy
from thermosplat.training.optimizers import gaussian_optimizers, set_learning_rates
from thermosplat.training.step_kind import StepKind
from thermosplat.training.trainer import Trainer
from toy_run import density_in_steps, step_gradients, toy_run_config, toy_trainer
from toy_scene import toy_capture

OFF = 0.003
FINE = torch.zeros(())


def two_opacity_gaussians(opacities: list[float], thermal_opacities: list[float]) -> Gaussians:
    """Small Gaussians with these opacities."""
    count = len(opacities)
    generator = torch.Generator().manual_seed(0)
    return Gaussians(
        {
            "means": torch.randn(count, 3, generator=generator),
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
            "log_scales": torch.full((count, 3), -6.0),
            "logit_opacities": torch.logit(torch.tensor(opacities)),
            "logit_thermal_opacities": torch.logit(torch.tensor(thermal_opacities)),
            "sh0": torch.rand(count, 1, 3, generator=generator),
        }
    )


def strategy_of(gaussians: Gaussians, **config: Any) -> tuple[DecomposingStrategy, Optimizers]:
    settings = {"strategy": "decomposing", "grad_threshold": 2e-4} | config
    densification = density_in_steps(**settings)
    strategy = DecomposingStrategy(densification, 3.0, len(gaussians), "cpu", spectra=("rgb", "thermal"))
    return strategy, gaussian_optimizers(gaussians, OptimizerConfig())


def info(spectrum: str, gradients: list[list[float]], width: int = 40, height: int = 30) -> dict[str, Any]:
    """What a call says, with a backward pass behind it; gradients in units of half the image."""
    means2d = torch.zeros(1, len(gradients), 2, requires_grad=True)
    means2d.grad = torch.tensor(gradients)[None] / torch.tensor([width / 2.0, height / 2.0])
    visible = torch.ones(1, len(gradients), dtype=torch.bool)
    return {"means2d": means2d, "visible": visible, "width": width, "height": height, "spectra": (spectrum,)}


def refine(strategy: DecomposingStrategy, gaussians: Gaussians, optimizers: Optimizers) -> None:
    strategy.refine(gaussians, optimizers, 601, torch.Generator().manual_seed(0))


def opacities(gaussians: Gaussians) -> Tensor:
    return torch.stack([gaussians.opacities, gaussians.opacities_in("thermal")], dim=-1).detach()


def test_conflicting_gaussian_becomes_one_of_each() -> None:
    """Pulled apart by more than the threshold: a visible one in place, a thermal one at the end, at the same mean."""
    gaussians = two_opacity_gaussians([0.6, 0.7], [0.8, 0.9])
    strategy, optimizers = strategy_of(gaussians)
    mean = gaussians.means[0].detach().clone()
    calm = [0.0, 1e-5]
    strategy.observe([info("rgb", [[5e-4, 0.0], calm]), info("thermal", [[0.0, 4e-4], calm])], FINE)
    refine(strategy, gaussians, optimizers)
    torch.testing.assert_close(opacities(gaussians), torch.tensor([[0.6, OFF], [0.7, 0.9], [OFF, 0.8]]))
    assert torch.equal(gaussians.means[2], mean)
    assert strategy.gradient_sums.shape == (2, 3, 2)
    assert not strategy.gradient_sums.any()


@pytest.mark.parametrize(
    ("rgb", "thermal", "divided"),
    [
        ([5e-4, 0.0], [0.0, 5e-4], True),
        ([3e-4, 0.0], [3e-4, 0.0], False),  # both pull the same way: growth's business
        ([3e-4, 0.0], [-3e-4, 0.0], False),  # as a sum they do not pull at all
        ([1e-4, 0.0], [0.0, 1e-4], False),
    ],
)
def test_what_counts_as_a_conflict(rgb: list[float], thermal: list[float], divided: bool) -> None:
    """The difference and the sum of both mean gradients have to exceed the threshold."""
    gaussians = two_opacity_gaussians([0.6], [0.8])
    strategy, _ = strategy_of(gaussians)
    for _ in range(2):  # means over views, not sums
        strategy.observe([info("rgb", [rgb]), info("thermal", [thermal])], FINE)
    assert strategy.conflicting(gaussians).tolist() == [divided]


def test_gaussian_of_one_spectrum_is_not_divided_again() -> None:
    """Only what both spectra see can be divided."""
    gaussians = two_opacity_gaussians([0.6], [OFF])
    strategy, _ = strategy_of(gaussians)
    strategy.observe([info("rgb", [[9e-4, 0.0]]), info("thermal", [[0.0, 9e-4]])], FINE)
    assert strategy.conflicting(gaussians).tolist() == [False]


def test_blocked_steps_are_not_noted() -> None:
    """A step whose gradients are not finite leaves the sums alone."""
    gaussians = two_opacity_gaussians([0.6], [0.6])
    strategy, _ = strategy_of(gaussians)
    strategy.observe([info("rgb", [[float("nan"), 0.0]])], torch.ones(()))
    assert not strategy.gradient_sums.any()
    assert strategy.observations.tolist() == [0.0]


def test_faint_in_one_spectrum_goes_unless_clear_in_the_other() -> None:
    """MMOne's pruning: kept ones are switched off where they are faint."""
    gaussians = two_opacity_gaussians([0.004, 0.004, 0.3, 0.9], [0.9, 0.3, 0.3, 0.002])
    strategy, optimizers = strategy_of(gaussians)
    refine(strategy, gaussians, optimizers)
    torch.testing.assert_close(opacities(gaussians), torch.tensor([[OFF, 0.9], [0.3, 0.3], [0.9, OFF]]))


@pytest.mark.parametrize("log_scale", [-6.0, -2.0])
def test_divided_gaussians_are_spared_once(log_scale: float) -> None:
    """Just divided they may be faint in either spectrum; at the next refinement they must have become clear in one.

    Meanwhile the first Gaussian is cloned or, large, replaced by its halves, which moves nobody's sparing to another.
    """
    gaussians = two_opacity_gaussians([0.3, 0.3, 0.004], [0.3, 0.3, 0.3])
    with torch.no_grad():
        gaussians.log_scales[0] = log_scale
    strategy, optimizers = strategy_of(gaussians)
    growing, calm = [9e-4, 0.0], [0.0, 0.0]
    strategy.observe([info("rgb", [growing, [5e-4, 0.0], calm]), info("thermal", [growing, [0.0, 5e-4], calm])], FINE)
    refine(strategy, gaussians, optimizers)
    assert sorted(opacities(gaussians).amin(dim=-1).tolist()) == pytest.approx([OFF, OFF, 0.3, 0.3])
    refine(strategy, gaussians, optimizers)
    torch.testing.assert_close(opacities(gaussians), torch.full((2, 2), 0.3))


def test_refinement_after_growth_has_stopped() -> None:
    """``--budget auto`` ends growth: nothing is divided any more, and what was divided is spared no longer."""
    gaussians = two_opacity_gaussians([0.3, 0.3, 0.004], [0.3, 0.3, 0.3])
    strategy, optimizers = strategy_of(gaussians)
    calm = [0.0, 0.0]
    strategy.observe([info("rgb", [[5e-4, 0.0], calm, calm]), info("thermal", [[0.0, 5e-4], calm, calm])], FINE)
    refine(strategy, gaussians, optimizers)
    assert len(gaussians) == 3  # the first twice, and the second
    strategy.growing = False
    strategy.observe([info("rgb", [calm, [5e-4, 0.0], calm]), info("thermal", [calm, [0.0, 5e-4], calm])], FINE)
    refine(strategy, gaussians, optimizers)
    torch.testing.assert_close(opacities(gaussians), torch.full((1, 2), 0.3))


def test_switched_off_stays_off() -> None:
    """Adam's momentum from before brings no Gaussian back into a spectrum: not a divided one, not one that faded."""
    gaussians = two_opacity_gaussians([0.6, 0.004], [0.8, 0.9])
    strategy, optimizers = strategy_of(gaussians)
    set_learning_rates(optimizers, OptimizerConfig(), 0.0, 1.0)
    names = ("logit_opacities", "logit_thermal_opacities")
    before = {name: gaussians.get_parameter(name).detach().clone() for name in names}

    def advance(gradient: float) -> None:
        for name in names:
            parameter = gaussians.get_parameter(name)
            parameter.grad = torch.full_like(parameter, gradient)
            optimizers[name].step()

    for _ in range(30):
        advance(-1.0)  # both opacities rise
    for name in names:
        gaussians.get_parameter(name).data.copy_(before[name])
    strategy.observe([info("rgb", [[5e-4, 0.0], [0.0, 0.0]]), info("thermal", [[0.0, 5e-4], [0.0, 0.0]])], FINE)
    refine(strategy, gaussians, optimizers)
    switched_off = torch.tensor([[False, True], [True, False], [True, False]])
    assert torch.equal(opacities(gaussians) < 1 / 255, switched_off)
    for _ in range(100):
        advance(0.0)  # nobody sees what is off
    torch.testing.assert_close(opacities(gaussians)[switched_off], torch.full((3,), OFF))
    assert opacities(gaussians)[0, 0] > 0.65  # others go on


@pytest.mark.parametrize(("cap", "divided"), [(3, []), (4, []), (6, [1, 3]), (7, [1, 2, 3]), (None, [0, 1, 2, 3])])
def test_cap_lets_the_farthest_apart_be_divided(cap: int | None, divided: list[int]) -> None:
    """Close to the cap those are divided that are pulled apart most, up to the cap exactly; the others stay as is."""
    gaussians = two_opacity_gaussians([0.3] * 4, [0.4] * 4)
    strategy, optimizers = strategy_of(gaussians, max_gaussians=cap)
    strengths = (5e-4, 8e-4, 6e-4, 7e-4)
    infos = [info("rgb", [[s, 0.0] for s in strengths]), info("thermal", [[0.0, s] for s in strengths])]
    strategy.observe(infos, FINE)
    refine(strategy, gaussians, optimizers)
    assert len(gaussians) == 4 + len(divided)
    assert torch.where(gaussians.opacities_in("thermal") < 1 / 255)[0].tolist() == divided
    assert torch.where(gaussians.opacities < 1 / 255)[0].tolist() == list(range(4, len(gaussians)))


def test_state_survives_a_checkpoint() -> None:
    """The sums go into a checkpoint and come back."""
    gaussians = two_opacity_gaussians([0.6], [0.8])
    strategy, _ = strategy_of(gaussians)
    strategy.observe([info("rgb", [[5e-4, 0.0]]), info("thermal", [[0.0, 4e-4]])], FINE)
    other, _ = strategy_of(gaussians)
    other.load_state_dict(strategy.state_dict())
    assert torch.equal(other.gradient_sums, strategy.gradient_sums)
    assert other.conflicting(gaussians).tolist() == [True]


def test_state_of_a_strategy_that_did_not_divide() -> None:
    """Its sums come back; gradients by spectrum, which it did not note, start at zero, for as many Gaussians."""
    gaussians = two_opacity_gaussians([0.6], [0.8])
    plain = DefaultStrategy(DensificationConfig(), 3.0, len(gaussians), "cpu")
    plain.grad_norm_sum += 5e-4
    plain.observations += 1.0
    strategy, _ = strategy_of(gaussians)
    strategy.gradient_sums += 1.0
    strategy.load_state_dict(plain.state_dict())
    assert strategy.grad_norm_sum.tolist() == plain.grad_norm_sum.tolist()
    assert strategy.gradient_sums.tolist() == [[[0.0, 0.0]], [[0.0, 0.0]]]
    assert strategy.conflicting(gaussians).tolist() == [False]


def test_any_two_spectra_are_divided() -> None:
    """Whatever they are called: the first has α, and the second's own logits are found by its name."""
    gaussians = two_opacity_gaussians([0.6], [0.8])
    renamed = {name.replace("thermal", "nir"): value for name, value in gaussians.named_parameters()}
    gaussians = Gaussians({name: value.detach() for name, value in renamed.items()})
    config = density_in_steps(strategy="decomposing", grad_threshold=2e-4)
    strategy = DecomposingStrategy(config, 3.0, 1, "cpu", spectra=("thermal", "nir"))
    strategy.observe([info("nir", [[0.0, 4e-4]]), info("thermal", [[5e-4, 0.0]])], FINE)
    torch.testing.assert_close(strategy.gradient_sums[:, 0], torch.tensor([[5e-4, 0.0], [0.0, 4e-4]]))
    refine(strategy, gaussians, gaussian_optimizers(gaussians, OptimizerConfig()))
    torch.testing.assert_close(gaussians.opacities, torch.tensor([0.6, OFF]))
    torch.testing.assert_close(gaussians.opacities_in("nir"), torch.tensor([OFF, 0.8]))


def test_spectra_are_rendered_apart(tmp_path: Path) -> None:
    """A frame of one camera is rendered by a call for each spectrum: their gradients must not be one sum."""
    spectra = {"thermal": {"opacity": "own"}}
    for strategy, expected in (("default", [("rgb", "thermal")]), ("decomposing", [("rgb",), ("thermal",)])):
        config = toy_run_config(spectra=spectra)
        densification = dataclasses.replace(config.densification, strategy=strategy)
        config = dataclasses.replace(config, densification=densification)
        trainer = toy_trainer(tmp_path / strategy, config, toy_capture())
        kind = StepKind(0, densifying=False)
        done = step_gradients(trainer, kind)
        assert [info["spectra"] for info in done.rendered.infos["shared"]] == expected


def test_resumed_run_may_begin_to_divide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run without decomposition goes on with it, as every setting of densification may change on --resume."""
    config = toy_run_config(12, spectra={"thermal": {"opacity": "own"}})
    first = toy_trainer(tmp_path, config, toy_capture())
    while first.step < 5:
        first.train_step()
    first.save()
    densification = dataclasses.replace(config.densification, strategy="decomposing")
    monkeypatch.setattr(decomposition, "CONFLICT_THRESHOLD", 1e-6)
    changed = dataclasses.replace(config, densification=densification)
    resumed = Trainer.resume(changed, toy_capture(), RunDirectory.open(tmp_path))
    while resumed.step < 7:  # to the next refinement
        resumed.train_step()
    (gaussians,) = resumed.state.gaussian_sets.values()
    assert (gaussians.opacities_in("thermal") < 1 / 255).any()
