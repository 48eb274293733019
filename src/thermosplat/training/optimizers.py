"""Adam for every parameter, and its learning rate at every step.

A learning rate is a function of the step, so there is no scheduler with a state of its own. Parameters named
``log_scales`` or ``logit_opacities`` take the rates ``scales_lr`` and ``opacities_lr`` of ``OptimizerConfig``; where
the configuration has ``<name>_lr_final``, the rate decays exponentially to it over the run, else it stays constant.
"""

from typing import Any

import torch
from torch import Tensor, nn

from thermosplat.config import OptimizerConfig
from thermosplat.training.gaussian_ops import Optimizers


def learning_rate(name: str, config: OptimizerConfig, progress: float, scene_extent: float) -> float:
    """Learning rate of a parameter.

    Args:
        name: Parameter name of a set of Gaussians, or "decoders".
        config: The rates.
        progress: Share of the run that is done, 0 to 1.
        scene_extent: Radius of the cameras [world units]; scales the rate of the means. 3DGS.
    """
    field = name.removeprefix("log_").removeprefix("logit_") + "_lr"
    rate = getattr(config, field)
    final = getattr(config, f"{field}_final", rate)
    if final != rate:
        rate = rate * (final / rate) ** min(progress, 1.0)
    return rate * scene_extent if name == "means" else rate


def gaussian_optimizers(gaussians: nn.Module, config: OptimizerConfig) -> Optimizers:
    """One Adam for each parameter of a set of Gaussians, by name."""
    return {name: _adam([parameter], config) for name, parameter in gaussians.named_parameters()}


def decoder_optimizer(decoders: nn.Module, config: OptimizerConfig) -> torch.optim.Adam:
    """Adam for the decoder networks."""
    return _adam(list(decoders.parameters()), config)


def _adam(parameters: list[nn.Parameter], config: OptimizerConfig) -> torch.optim.Adam:
    # fused: one kernel for the whole update on both devices (ten times faster than torch's loop on the CPU), and the
    # one variant that can be told on the device, without waiting for it, to leave the parameters alone (found_inf)
    optimizer = torch.optim.Adam(parameters, lr=0.0, eps=config.eps, fused=True)
    _put_rate_on_device(optimizer)
    return optimizer


def load_optimizer(optimizer: torch.optim.Adam, state: dict[str, Any]) -> None:
    """Go on from a checkpoint's state of an optimizer, which may have run on another device.

    Args:
        optimizer: Of the same parameters.
        state: Its ``state_dict()``.
    """
    optimizer.load_state_dict(state)
    _put_rate_on_device(optimizer)


def _put_rate_on_device(optimizer: torch.optim.Adam) -> None:
    """On CUDA the rate is a tensor that stays, so that a captured step sees it change; on the CPU a number."""
    for group in optimizer.param_groups:
        device = group["params"][0].device
        group["capturable"] = device.type == "cuda"
        group["lr"] = torch.zeros((), device=device) if group["capturable"] else 0.0


def set_learning_rates(optimizers: Optimizers, config: OptimizerConfig, progress: float, scene_extent: float) -> None:
    """Set the rates of optimizers, given by parameter name, for the step to come."""
    for name, optimizer in optimizers.items():
        rate = learning_rate(name, config, progress, scene_extent)
        for group in optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate


def step_unless(blocked: Tensor, optimizers: Optimizers) -> None:
    """Apply the gradients, except where a device flag says that they are not finite.

    Args:
        blocked: float32 scalar on the parameters' device; 1 leaves parameters and moments as they are.
        optimizers: The optimizers.
    """
    for optimizer in optimizers.values():
        optimizer.found_inf = blocked  # type: ignore[attr-defined]  # as torch.amp.GradScaler tells a fused optimizer
        optimizer.step()
