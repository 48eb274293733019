"""Noticing losses and gradients that are not finite, without waiting for the device at every step."""

import torch
from torch import Tensor

from thermosplat.fused.finite_check import note_by_warp


class FiniteGuard:
    """Remembers, on the device, the first step whose losses or gradients were NaN or infinite.

    ``blocked`` is handed to the optimizers, which leave everything as it is from that step on, so the last good state
    is still there when somebody looks, however much later.

    Args:
        device: Where losses and gradients are.
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
            losses: The loss terms, scalars, by name.
            gradients: Gradients by the name of what they belong to.
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
