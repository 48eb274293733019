"""Density control grows, prunes and resets as gsplat's does, and as its documented differences say."""

from typing import Any

import pytest
import torch
from torch import Tensor

from random_gaussians import random_gaussians, stepped_optimizers
from thermosplat.config import DensificationConfig
from thermosplat.errors import UserError
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.density import gradient_control
from thermosplat.training.density.gaussian_ops import Optimizers
from thermosplat.training.density.gradient_control import DefaultStrategy, Refinement
from toy_run import density_in_steps

EXTENT = 3.0
FINE = torch.zeros(())


@pytest.fixture(autouse=True)
def _toy_sizes() -> None:
    """Sizes are the published ones here."""


def _info(gradient: Tensor, visible: Tensor, width: int = 40, height: int = 30) -> dict[str, Any]:
    """What the rasterization tells, with a backward pass behind it: gradient [C, N, 2], visible [C, N]."""
    means2d = torch.zeros_like(gradient, requires_grad=True)
    means2d.grad = gradient
    radii = visible[..., None].expand(*visible.shape, 2).to(torch.int32) * 3  # gsplat's strategy looks at these
    size = {"width": width, "height": height, "n_cameras": gradient.shape[0]}
    return {"means2d": means2d, "visible": visible, "radii": radii, **size}


def _gradients(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Gradients around the threshold in a 40x30 image, and who is visible."""
    generator = torch.Generator().manual_seed(seed)
    gradient = 1.3e-5 * torch.randn(1, count, 2, generator=generator)
    return gradient, torch.rand(1, count, generator=generator) < 0.8


def _run(
    strategy: DefaultStrategy, gaussians: Gaussians, optimizers: Optimizers, infos: list[dict[str, Any]], step: int
) -> Refinement | None:
    generator = torch.Generator().manual_seed(step)
    if strategy.is_active(step):
        strategy.observe(infos, FINE)
    return strategy.refine(gaussians, optimizers, step, generator)


def _strategy(gaussians: Gaussians, **config: Any) -> DefaultStrategy:
    config = {"grad_threshold": 2e-4} | config  # 3DGS's and gsplat's
    return DefaultStrategy(density_in_steps(**config), EXTENT, len(gaussians), "cpu")


def test_a_share_without_gaussians_notes_nothing() -> None:
    """Of a rank where there are fewer Gaussians than ranks."""
    strategy = DefaultStrategy(DensificationConfig(), EXTENT, 0, "cpu")
    strategy.observe([_info(torch.zeros(1, 0, 2), torch.zeros(1, 0, dtype=torch.bool))], FINE)
    assert strategy.grad_norm_sum.shape == strategy.observations.shape == (0,)


@pytest.mark.parametrize("step", [600, 3100])
def test_same_gaussians_as_gsplat(step: int) -> None:
    """The same gradients over four frames clone, split and prune the same Gaussians as gsplat's DefaultStrategy.

    Step 3100 lies after the first reset, when Gaussians that are too large go as well. Splits draw their own means, so
    everything but the means is compared.
    """
    gsplat_strategy = pytest.importorskip("gsplat.strategy", reason="gsplat is not installed")
    gaussians = random_gaussians(400, thermal=False)
    with torch.no_grad():
        gaussians.log_scales[::40] += 4.0  # some larger than a tenth of the scene
    optimizers = stepped_optimizers(gaussians)
    theirs = {"means": gaussians.means, "scales": gaussians.log_scales, "quats": gaussians.quats}
    params = {name: torch.nn.Parameter(value.detach().clone()) for name, value in theirs.items()}
    params["opacities"] = torch.nn.Parameter(gaussians.logit_opacities.detach().clone())
    their_optimizers = {name: torch.optim.Adam([param]) for name, param in params.items()}
    reference = gsplat_strategy.DefaultStrategy()
    state = reference.initialize_state(scene_scale=EXTENT)
    strategy = _strategy(gaussians)

    refinement = None
    for number in (step - 3, step - 2, step - 1, step):
        gradient, visible = _gradients(400, number)
        refinement = _run(strategy, gaussians, optimizers, [_info(gradient, visible)], number + 1)  # ours count from 1
        info = {**_info(gradient, visible), "gaussian_ids": None}
        reference.step_post_backward(params, their_optimizers, state, number, info)

    assert refinement is not None
    assert min(refinement.cloned, refinement.split, refinement.pruned) > 5
    assert len(gaussians) == 400 + refinement.cloned + refinement.split - refinement.pruned
    assert torch.equal(gaussians.logit_opacities, params["opacities"])
    assert torch.equal(gaussians.quats, params["quats"])
    torch.testing.assert_close(gaussians.log_scales, params["scales"])


@pytest.mark.parametrize(
    ("step", "refines"),
    [(501, False), (551, False), (600, False), (601, True), (14_901, True), (15_001, False), (20_001, False)],
)
def test_refinements_follow_the_schedule_of_3dgs(step: int, refines: bool) -> None:
    """Refinements follow every 100 steps between 500 and 15,000, both excluded, one step later. 3DGS."""
    gaussians = random_gaussians(50)
    result = _run(_strategy(gaussians), gaussians, stepped_optimizers(gaussians), [_info(*_gradients(50, 0))], step)
    assert (result is not None) == refines


def test_switched_off_changes_nothing() -> None:
    """Without densification neither refinement nor reset happens."""
    gaussians = random_gaussians(50)
    opacities = gaussians.opacities.detach()
    strategy = _strategy(gaussians, stop_step=0)
    assert _run(strategy, gaussians, stepped_optimizers(gaussians), [_info(*_gradients(50, 0))], 3000) is None
    assert len(gaussians) == 50
    torch.testing.assert_close(gaussians.opacities, opacities, atol=0.02, rtol=0)  # one optimizer step away


def test_opacities_are_reset() -> None:
    """One step after every 3,000 (so that an evaluation at 3,000 sees the trained opacities) none stays above 0.01.

    Not so at 15,001, when density control is over.
    """
    for step, largest in ((3000, 1.0), (3001, 0.0101), (12_001, 0.0101), (15_001, 1.0)):
        gaussians = random_gaussians(50)
        _run(_strategy(gaussians), gaussians, stepped_optimizers(gaussians), [_info(*_gradients(50, 0))], step)
        for opacities in (gaussians.opacities, gaussians.opacities_in("thermal")):
            assert opacities.max() <= largest
            assert (opacities.max() > 0.5) == (largest == 1.0)


def test_bright_in_one_spectrum_is_enough_to_stay() -> None:
    """A Gaussian is pruned when α and α_t are both low."""
    gaussians = random_gaussians(4)
    with torch.no_grad():
        gaussians.log_scales.fill_(-4.0)
        gaussians.logit_opacities.copy_(torch.tensor([-8.0, -8.0, 2.0, 2.0]))
        gaussians.thermal_opacity_offsets.copy_(torch.tensor([0.0, 10.0, 0.0, -10.0]))
    still = torch.zeros(1, 4, 2), torch.ones(1, 4, dtype=torch.bool)
    refinement = _run(_strategy(gaussians), gaussians, stepped_optimizers(gaussians), [_info(*still)], 601)
    assert refinement == Refinement(cloned=0, split=0, pruned=1)
    assert gaussians.opacities.max() > 0.8


def test_one_spectrum_of_several_is_enough_to_stay() -> None:
    """With four opacities a Gaussian is pruned when all are low, and reset in all."""
    gaussians = random_gaussians(5, others={"nir": "own", "red_edge": "offset", "blue": "shared"})
    rows = {  # the last Gaussian is faint in every spectrum
        "logit_opacities": [2.0, -8.0, -8.0, -8.0, -8.0],
        "thermal_opacity_offsets": [-10.0, 10.0, 0.0, 0.0, 0.0],
        "logit_nir_opacities": [-8.0, -8.0, 2.0, -8.0, -8.0],
        "red_edge_opacity_offsets": [-10.0, 0.0, 0.0, 10.0, 0.0],
    }
    with torch.no_grad():
        gaussians.log_scales.fill_(-4.0)
        for name, values in rows.items():
            gaussians.get_parameter(name).copy_(torch.tensor(values))
    kept = gaussians.means[:4].detach().clone()
    strategy, optimizers = _strategy(gaussians, reset_every=700), stepped_optimizers(gaussians)
    with torch.no_grad():
        for name, values in rows.items():
            gaussians.get_parameter(name).copy_(torch.tensor(values))
        gaussians.means[:4] = kept
    assert strategy.refine(gaussians, optimizers, 601, torch.Generator()) == Refinement(pruned=1)
    assert torch.equal(gaussians.means, kept)
    clear = gaussians.largest_opacities
    assert (clear > 0.8).all()
    assert strategy.refine(gaussians, optimizers, 701, torch.Generator()) == Refinement()
    for name in ("rgb", "thermal", "nir", "red_edge", "blue"):
        assert gaussians.opacities_in(name).max() <= 0.0101


def test_large_ones_go_only_later() -> None:
    """At the refinement of that very step they still stay, as gsplat's do; at the next one they go."""
    for step, expected in ((601, 0), (701, 5)):
        gaussians = random_gaussians(30, thermal=False)
        with torch.no_grad():
            gaussians.logit_opacities.fill_(0.0)
            gaussians.log_scales.fill_(-4.0)
            gaussians.log_scales[:5] = 0.0  # a third of the scene
        strategy = _strategy(gaussians, reset_every=600)
        refinement = strategy.refine(gaussians, stepped_optimizers(gaussians), step, torch.Generator())
        assert refinement == Refinement(pruned=expected)


def test_cap_lets_the_largest_gradients_grow() -> None:
    """Close to the cap, the Gaussians with the largest gradients grow, up to the cap exactly."""
    gaussians = random_gaussians(20)
    with torch.no_grad():
        gaussians.logit_opacities.fill_(1.0)
        gaussians.log_scales.fill_(-8.0)
        gaussians.means[:, 0] = torch.arange(20.0)
    gradient = torch.zeros(1, 20, 2)
    gradient[0, :, 1] = torch.linspace(1e-3, 2e-3, 20)  # all above the threshold
    visible = torch.ones(1, 20, dtype=torch.bool)
    strategy = _strategy(gaussians, max_gaussians=23)
    refinement = _run(strategy, gaussians, stepped_optimizers(gaussians), [_info(gradient, visible)], 601)
    assert refinement == Refinement(cloned=3, split=0, pruned=0)
    assert sorted(gaussians.means[20:, 0].round().tolist()) == [17.0, 18.0, 19.0]
    again = _info(*(torch.cat([part, part[:, :3]], dim=1) for part in (gradient, visible)))
    assert _run(strategy, gaussians, stepped_optimizers(gaussians), [again], 701) == Refinement()


def test_gradient_is_measured_in_half_images() -> None:
    """Pixel gradients count in units of half the image, and only in frames where the Gaussian is visible."""
    gaussians = random_gaussians(2)
    strategy = _strategy(gaussians)
    seen = torch.tensor([[True, True]])
    _run(strategy, gaussians, {}, [_info(torch.full((1, 2, 2), 1.0), seen, width=6, height=8)], 1)
    _run(strategy, gaussians, {}, [_info(torch.full((1, 2, 2), 1.0), ~seen, width=6, height=8)], 2)
    assert strategy.grad_norm_sum.tolist() == [5.0, 5.0]  # (6/2, 8/2) has norm 5
    assert strategy.observations.tolist() == [1.0, 1.0]


def test_two_cameras_of_a_frame_are_one_observation() -> None:
    """Norms of both spectra add up, each in its own half images, and the frame counts once."""
    gaussians = random_gaussians(3)
    strategy = _strategy(gaussians)
    rgb = _info(torch.ones(1, 3, 2), torch.tensor([[True, True, False]]), width=6, height=8)
    thermal = _info(-torch.ones(1, 3, 2), torch.tensor([[True, False, False]]), width=12, height=16)
    _run(strategy, gaussians, {}, [rgb, thermal], 1)
    assert strategy.grad_norm_sum.tolist() == [15.0, 5.0, 0.0]
    assert strategy.observations.tolist() == [1.0, 1.0, 0.0]


def test_three_cameras_of_a_frame_are_one_observation() -> None:
    """A call that renders two spectra counts once, whose gradient is their sum; a third camera's norm is added."""
    gaussians = random_gaussians(2)
    strategy = _strategy(gaussians)
    seen = torch.tensor([[True, True]])
    both = _info(torch.ones(1, 2, 2), seen, width=6, height=8) | {"spectra": ("rgb", "nir")}
    thermal = _info(torch.ones(1, 2, 2), ~seen, width=6, height=8) | {"spectra": ("thermal",)}
    blue = _info(-torch.ones(1, 2, 2), seen, width=12, height=16) | {"spectra": ("blue",)}
    _run(strategy, gaussians, {}, [both, thermal, blue], 1)
    assert strategy.grad_norm_sum.tolist() == [15.0, 15.0]
    assert strategy.observations.tolist() == [1.0, 1.0]


def test_absgrad_is_used_when_asked_for() -> None:
    """With absgrad the sums come from means2d.absgrad."""
    gaussians = random_gaussians(2)
    strategy = _strategy(gaussians, absgrad=True)
    info = _info(torch.zeros(1, 2, 2), torch.ones(1, 2, dtype=torch.bool), width=6, height=8)
    info["means2d"].absgrad = torch.ones(1, 2, 2)
    _run(strategy, gaussians, {}, [info], 1)
    assert strategy.grad_norm_sum.tolist() == [5.0, 5.0]


def test_bad_gradients_are_not_noted() -> None:
    """A step that the guard blocked leaves the sums as they are."""
    gaussians = random_gaussians(2)
    strategy = _strategy(gaussians)
    info = _info(torch.full((1, 2, 2), torch.nan), torch.ones(1, 2, dtype=torch.bool))
    strategy.observe([info], torch.ones(()))
    assert strategy.grad_norm_sum.tolist() == [0.0, 0.0]
    assert strategy.observations.tolist() == [0.0, 0.0]


def test_losing_every_gaussian_is_an_error() -> None:
    """A scene that fades away altogether stops with the step and what to look at."""
    gaussians = random_gaussians(3)
    with torch.no_grad():
        gaussians.logit_opacities.fill_(-9.0)
        gaussians.thermal_opacity_offsets.fill_(0.0)
    still = torch.zeros(1, 3, 2), torch.ones(1, 3, dtype=torch.bool)
    with pytest.raises(UserError, match="No Gaussian is left after the refinement of step 601"):
        _run(_strategy(gaussians), gaussians, stepped_optimizers(gaussians), [_info(*still)], 601)
    assert len(gaussians) == 3


def test_out_of_memory_between_two_operations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory that runs out after growing, before pruning, leaves sums that fit the Gaussians there are."""
    gaussians = random_gaussians(20)
    gaussians.set_opacity_logits(torch.tensor([0]), torch.tensor([-20.0]), {"thermal": torch.tensor([-20.0])})
    strategy = _strategy(gaussians)
    monkeypatch.setattr(gradient_control, "GROW_SCALE3D", 0.02)
    info = _info(torch.full((1, 20, 2), 1.0), torch.ones(1, 20, dtype=torch.bool))

    def exhausted(*args: object) -> None:
        raise torch.OutOfMemoryError

    monkeypatch.setattr(gradient_control, "prune", exhausted)
    with pytest.raises(torch.OutOfMemoryError):
        _run(strategy, gaussians, stepped_optimizers(gaussians), [info], 601)
    assert len(gaussians) > 20
    assert strategy.grad_norm_sum.tolist() == [0.0] * len(gaussians)
    assert strategy.observations.tolist() == [0.0] * len(gaussians)


def test_state_comes_back() -> None:
    """A strategy that is loaded goes on with the sums of the one that was saved."""
    gaussians = random_gaussians(20)
    strategy, other = _strategy(gaussians), _strategy(gaussians)
    _run(strategy, gaussians, {}, [_info(*_gradients(20, 0))], 1)
    other.load_state_dict(strategy.state_dict())
    assert strategy.grad_norm_sum.any()
    assert torch.equal(other.grad_norm_sum, strategy.grad_norm_sum)
    assert torch.equal(other.observations, strategy.observations)
