"""gsplat's MCMCStrategy on our rasterizer. (DefaultStrategy: test_rasterization_gsplat.)"""

from typing import Any

import pytest
import torch

import reference_rasterizer
from gaussian_scenes import gsplat_training, random_scene
from repository_documents import code_blocks
from thermosplat import rasterization


def test_mcmc_strategy_densifies(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """It relocates the dead, adds Gaussians and noise, and training goes on."""
    strategies = pytest.importorskip("gsplat.strategy", reason="gsplat 1.5.3 is not installed")
    for name in ("compute_relocation", "quat_scale_to_covar_preci"):  # put back afterwards
        monkeypatch.setattr(strategies.ops, name, getattr(strategies.ops, name))
    (lines,) = [code for code in code_blocks("docs/migrating.md", "py") if "compute_relocation" in code]
    exec(lines, {})
    scene = random_scene(n=60, backgrounds=False)
    scene["opacities"][:6] = 0.001  # dead
    target = reference_rasterizer.rasterization(**random_scene(n=60, seed=1, backgrounds=False))[0].float().to(device)
    params, optimizers = gsplat_training(scene, device)
    strategy = strategies.MCMCStrategy(cap_max=66, refine_start_iter=1, refine_every=2, min_opacity=0.005)
    strategy.check_sanity(params, optimizers)
    state: dict[str, Any] = strategy.initialize_state()
    losses, dead = [], []
    torch.manual_seed(0)
    for step in range(8):
        image, _, info = rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            params["colors"],
            scene["viewmats"].float().to(device),
            scene["Ks"].float().to(device),
            23,
            18,
            packed=False,
        )
        loss = (image - target).square().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, lr=1e-4)
        losses.append(loss.item())
        dead.append(int((params["opacities"].sigmoid() < 0.004).sum()))
    assert len(params["means"]) == 66
    assert dead[0] > 0
    assert dead[-1] == 0
    assert losses[-1] < losses[0]
    assert all(torch.isfinite(value).all() for value in params.values())
