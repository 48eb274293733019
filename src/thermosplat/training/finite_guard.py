"""Noticing losses and gradients that are not finite, without waiting for the device at every step."""

import torch
from torch import Tensor


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
        # a sum is finite only where all its terms are; an overflow of finite ones would be as fatal to Adam's squares
        sums = {f"gradient of {name}": _sum(tensors) for name, tensors in gradients.items() if tensors}
        values = {**{name: loss.detach() for name, loss in losses.items()}, **sums}
        names = tuple(values)
        bad = ~torch.isfinite(torch.stack(list(values.values())))
        if names not in self._first_bad_step:
            self._first_bad_step[names] = torch.zeros(len(names), dtype=torch.int64, device=bad.device)
        first = self._first_bad_step[names]
        first.copy_(torch.where(bad & (first == 0), step, first))
        self.blocked.copy_(torch.maximum(self.blocked, bad.any().to(self.blocked.dtype)))

    def first_bad(self) -> tuple[int, str] | None:
        """Step and name of the first value that was not finite, or None. Waits for the device."""
        if not bool(self.blocked):
            return None
        found = [
            (step, name)
            for names, first in self._first_bad_step.items()
            for step, name in zip(first.tolist(), names)
            if step > 0
        ]
        return min(found, key=lambda entry: entry[0])  # of one step, the first named: losses come before gradients


def _sum(tensors: list[Tensor]) -> Tensor:
    if len(tensors) == 1:
        return tensors[0].sum()
    return torch.cat([tensor.flatten() for tensor in tensors]).sum()
