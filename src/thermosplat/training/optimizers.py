"""Adam for every parameter, its learning rate at every step, and what keeps it from values that are not finite.

A learning rate is a function of the step, so there is no scheduler with a state of its own. Parameters named
``log_scales`` or ``logit_opacities`` take the rates ``scales_lr`` and ``opacities_lr`` of ``OptimizerConfig``, those of
one spectrum, such as ``thermal_sh0`` or ``thermal_opacity_offsets``, the rate of their kind, ``sh0_lr`` or
``opacities_lr``. Where the configuration has ``<name>_lr_final``, the rate decays exponentially to it over the run,
else to ``final_share`` of itself. Corrections of cameras have rates of their own (``camera_corrections.RATES``). From
``cooldown_from`` on every rate also falls to zero, in a straight line. Parameters that decay themselves are few: those
that the configuration has a ``<name>_decay`` for.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from thermosplat.config import OptimizerConfig
from thermosplat.fused.adam import WarpAdam, step_together
from thermosplat.fused.finite_check import note_by_warp
from thermosplat.fused.row_adam import RowAdam
from thermosplat.refinement.camera_corrections import RATES
from thermosplat.scene.gaussians import OFFSETS
from thermosplat.scene.offloaded import OffloadedParameter
from thermosplat.training.density.gaussian_ops import Optimizers

_LENGTHS = {"means", *RATES}
EPSILON = 1e-15
"""Adam's ε. 3DGS."""
_MOMENTS = {"step", "exp_avg", "exp_avg_sq"}
"""What Adam knows of a parameter."""


def learning_rate(name: str, config: OptimizerConfig, progress: float, scale: float) -> float:
    """Learning rate of a parameter.

    Args:
        name: Parameter name of a set of Gaussians, "decoders", or of the cameras' corrections.
        progress: Share of the run that is done, 0 to 1.
        scale: What rates of lengths are multiples of: for means the radius of the cameras [world units] (3DGS), for
            "poses" and "cameras" the width of the images [px].
    """
    if name in RATES:
        rate, final = RATES[name]
    else:
        field = f"{_kind(name)}_lr"
        rate = getattr(config, field)
        final = getattr(config, f"{field}_final", rate * config.final_share)
    progress = min(progress, 1.0)
    if rate > 0 and final != rate:
        rate = rate * (final / rate) ** progress
    if config.cooldown_from < 1:
        rate *= min((1.0 - progress) / (1.0 - config.cooldown_from), 1.0)
    return rate * scale if name in _LENGTHS else rate


def _kind(name: str) -> str:
    """Which rate a parameter takes, without "_lr"."""
    if name.endswith(("_sh0", "_shN")):
        return name.rpartition("_")[2]
    if name.endswith(OFFSETS) or name.startswith("logit_"):
        return "opacities"
    return name.removeprefix("log_")


def gaussian_optimizers(gaussians: nn.Module, config: OptimizerConfig) -> Optimizers:
    """One Adam for each parameter of a set of Gaussians, by name."""
    return parameter_optimizers(dict(gaussians.named_parameters()), config)


def parameter_optimizers(parameters: Mapping[str, nn.Parameter], config: OptimizerConfig) -> Optimizers:
    """One Adam for each of some parameters, by the name that its learning rate goes by."""
    decays = {"shN": config.shN_decay}
    return {name: _adam([parameter], decays.get(_kind(name), 0.0)) for name, parameter in parameters.items()}


def network_optimizer(network: nn.Module) -> torch.optim.Adam:
    """One Adam for all parameters of the decoders."""
    return _adam(list(network.parameters()))


def _adam(parameters: list[nn.Parameter], decay: float = 0.0) -> torch.optim.Adam:
    # fused: one kernel for the whole update (ten times faster than torch's loop on the CPU), and the one variant that
    # can be told on the device, without waiting for it, to leave the parameters alone (found_inf)
    device = parameters[0].device
    settings: dict[str, Any] = {"eps": EPSILON, "weight_decay": decay}
    if isinstance(parameters[0], OffloadedParameter):
        return RowAdam(parameters, lr=torch.zeros((), device=device), **settings)
    if device.type == "cuda":  # a rate that a captured step sees change
        return WarpAdam(parameters, lr=torch.zeros((), device=device), **settings, fused=True, capturable=True)
    kind = torch.optim.AdamW if decay > 0 else torch.optim.Adam
    return kind(parameters, lr=0.0, **settings, fused=True)


def load_optimizer(optimizer: torch.optim.Adam, state: dict[str, Any]) -> None:
    """Go on from a checkpoint's moments of an optimizer, which may have run on another device.

    Rates and all other settings are those of the optimizer at hand.

    Args:
        optimizer: Of the same parameters.
        state: Its ``state_dict()``.

    Raises:
        ValueError: Moments are missing, or are not of the parameters' shapes.
    """
    settings = [{key: value for key, value in group.items() if key != "params"} for group in optimizer.param_groups]
    optimizer.load_state_dict(state)
    for group, own in zip(optimizer.param_groups, settings):
        parameters = group["params"]
        group.clear()
        group.update(params=parameters, **own)
        for parameter in parameters:
            moments = optimizer.state.get(parameter, {})
            if moments and set(moments) != _MOMENTS:
                raise ValueError(f"an optimizer holds {', '.join(sorted(map(str, moments)))}")
            for name, moment in moments.items():
                if moment.shape != (() if name == "step" else parameter.shape):
                    raise ValueError(f"{name} of an optimizer has the shape {list(moment.shape)}")


def set_learning_rates(optimizers: Optimizers, config: OptimizerConfig, progress: float, scale: float) -> None:
    """Set the rates of optimizers, given by parameter name, for the step to come; as ``learning_rate``."""
    for name, optimizer in optimizers.items():
        rate = learning_rate(name, config, progress, scale)
        for group in optimizer.param_groups:
            if not isinstance(group["lr"], Tensor):
                group["lr"] = rate
            elif group.get("rate") != rate:  # of a captured step: it must stay the same tensor
                group["lr"].fill_(rate)
                group["rate"] = rate  # what the tensor holds, known without a look at the device


def step_unless(blocked: Tensor, optimizers: Mapping[str, Optimizers]) -> None:
    """Apply the gradients, except where a device flag says that they are not finite.

    Args:
        blocked: float32 scalar on the parameters' device; 1 leaves parameters and moments as they are.
    """
    every = [optimizer for owned in optimizers.values() for optimizer in owned.values()]
    by_warp = [optimizer for optimizer in every if isinstance(optimizer, WarpAdam)]
    if by_warp:
        step_together(by_warp, blocked)
    for optimizer in every:
        if isinstance(optimizer, RowAdam):
            optimizer.step_rows(blocked)
        elif not isinstance(optimizer, WarpAdam):
            optimizer.found_inf = blocked  # type: ignore[attr-defined]  # as torch.amp.GradScaler tells a fused one
            optimizer.step()


def set_betas(optimizers: Optimizers, betas: tuple[float, float]) -> None:
    """Let the moments of optimizers, given by parameter name, decay so fast."""
    for optimizer in optimizers.values():
        for group in optimizer.param_groups:
            group["betas"] = betas


def gradients_to_watch(optimizers: Mapping[str, Optimizers]) -> dict[str, list[Tensor]]:
    """The gradients there are, by owner and parameter name; the decoders' all under one name.

    Without those of spherical harmonics above degree 0, which are most of all numbers. They are the colours'
    gradients times values below 1, and those of degree 0 the same times a constant: finite where these are.

    Args:
        optimizers: By owner and parameter name.
    """
    return {
        owner if owner == name else f"{owner} {name}": [
            learnt.grad for learnt in _learnt(optimizer) if learnt.grad is not None and learnt.numel() > 0
        ]
        for owner, of_owner in optimizers.items()
        for name, optimizer in of_owner.items()
        if name != "shN" and not name.endswith("_shN")
    }


def _learnt(optimizer: torch.optim.Adam) -> list[Tensor]:
    """What may have gradients that an optimizer applies: its parameters, or rows of an offloaded one."""
    if isinstance(optimizer, RowAdam):
        return [] if optimizer.rows is None else [optimizer.rows.values]
    learnt: list[Tensor] = optimizer.param_groups[0]["params"]
    return learnt


class FiniteGuard:
    """Remembers, on the device, the first step whose losses or gradients were NaN or infinite.

    ``blocked`` is handed to the optimizers, which leave everything as it is from that step on, so the last good state
    is still there when somebody looks, however much later.
    """

    def __init__(self, device: torch.device | str) -> None:
        self.blocked = torch.zeros((), device=device)
        """float32 scalar: 0, and 1 from the first bad step on."""
        self._first_bad_step: dict[tuple[str, ...], Tensor] = {}

    @torch.no_grad()
    def observe(self, step: Tensor, losses: dict[str, Tensor], gradients: dict[str, list[Tensor]]) -> None:
        """Look at one step, before its update.

        Args:
            step: Its number, from 1; int64 scalar on the device.
        """
        named = {name: [loss.detach()] for name, loss in losses.items()}
        named |= {f"gradient of {name}": tensors for name, tensors in gradients.items() if tensors}
        names = tuple(named)
        if not names:  # of a rank that has neither a frame nor Gaussians
            return
        if names not in self._first_bad_step:
            self._first_bad_step[names] = torch.zeros(len(names), dtype=torch.int64, device=step.device)
        note = note_by_warp if step.is_cuda else note_by_torch
        note(list(named.values()), step, self._first_bad_step[names], self.blocked)

    def first_bad(self) -> tuple[int, str] | None:
        """Step and name of the first value that was not finite, or None. Waits for the device.

        Ranks share ``blocked``: where another rank found something, this one may have nothing to name.
        """
        if not bool(self.blocked):
            return None
        found = [
            (step, name)
            for names, first in self._first_bad_step.items()
            for step, name in zip(first.tolist(), names)
            if step > 0
        ]
        # of one step, the first named: losses come before gradients
        return min(found, key=lambda entry: entry[0], default=None)


def note_by_torch(named: list[list[Tensor]], step: Tensor, first_bad_step: Tensor, blocked: Tensor) -> None:
    """Note the step where something is not finite.

    Args:
        named: float32 tensors by name.
        step: The step's number, int64 scalar.
        first_bad_step: int64, one for each name, 0 as long as all was finite; changed in place.
        blocked: float32 scalar; 1 afterwards where something was not finite.
    """
    # a sum is finite only where all its terms are; an overflow of finite ones would be as fatal to Adam's squares
    bad = ~torch.isfinite(torch.stack([_sum(tensors) for tensors in named]))
    first_bad_step.copy_(torch.where(bad & (first_bad_step == 0), step, first_bad_step))
    blocked.copy_(torch.maximum(blocked, bad.any().to(blocked.dtype)))


def _sum(tensors: list[Tensor]) -> Tensor:
    if len(tensors) == 1:
        return tensors[0].sum() if tensors[0].dim() > 0 else tensors[0]
    return torch.cat([tensor.flatten() for tensor in tensors]).sum()
