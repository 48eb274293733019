"""Adam whose updates of CUDA parameters are one Warp kernel; elsewhere torch's own."""

import inspect
from collections.abc import Iterable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.arrays import numbered_parts, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.array_views import ArrayView, empty
from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.tensor_tables import BLOCK, addresses, counts, launches
from warp_kernels.training.adam import adam_coefficients_kernel, adam_update_kernel


class WarpAdam(torch.optim.Adam):
    """``torch.optim.Adam`` with the same state and, to rounding, the same update. Never waits for the device.

    With a ``weight_decay`` the update is that of ``torch.optim.AdamW``.

    Its rate ``lr`` must be a tensor on the parameters' device, so that a captured step sees it change. Its parameters
    must be contiguous.
    """

    # Torch's own, without what imports torch's compiler to hide them from it: a second of every start.
    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Apply the gradients, unless ``found_inf`` (set from outside, as by torch.amp.GradScaler) is not 0.

        Args:
            closure: Not supported; torch's signature has it.
        """
        step_together([self], self.found_inf)  # type: ignore[attr-defined]


@torch.no_grad()
def step_together(optimizers: Iterable[WarpAdam], blocked: Tensor) -> None:
    """Apply the gradients of several optimizers by the same launches.

    Args:
        optimizers: Of parameters on one device.
        blocked: float32 scalar on it; not 0: leave everything as it is.

    Raises:
        ValueError: A parameter is not contiguous.
    """
    tensors: dict[tuple[tuple[float, float], float, float], list[tuple[Tensor, ...]]] = {}
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            members = tensors.setdefault((tuple(group["betas"]), group["eps"], group["weight_decay"]), [])
            for parameter in group["params"]:
                if parameter.grad is None or parameter.numel() == 0:
                    continue
                state = optimizer.state[parameter]
                if not state:
                    if not parameter.is_contiguous():
                        shape, strides = tuple(parameter.shape), parameter.stride()
                        raise ValueError(f"Adam got a parameter {shape} with the strides {strides}, not contiguous.")
                    state["step"] = torch.zeros((), device=parameter.device)
                    state["exp_avg"] = torch.zeros_like(parameter)
                    state["exp_avg_sq"] = torch.zeros_like(parameter)
                whole = parameter, parameter.grad.contiguous(), state["exp_avg"], state["exp_avg_sq"]
                for number, part in enumerate(zip(*map(numbered_parts, whole), strict=True)):
                    # An update counts its step: parts after the first count copies.
                    steps = state["step"] if number == 0 else state["step"].clone()
                    members.append((*part, steps, group["lr"]))
    with launches_on_torch_stream(blocked.device) as device:
        stop = _flat(blocked)
        for (betas, eps, decay), members in tensors.items():
            columns = [[_flat(member[place]) for member in members] for place in range(6)]
            sizes = [len(part) for part in columns[0]]
            for some, ends in launches(sizes):
                parameters, gradients, averages, squares, steps, rates = (addresses(one[some]) for one in columns)
                count = len(sizes[some])
                coefficients = empty(count, wp.vec3, device)
                inputs = [*betas, decay, rates, stop, steps, coefficients]
                launch_again(adam_coefficients_kernel, count, inputs, device)
                inputs = [counts(ends), counts(sizes[some]), 1.0 - betas[0], betas[1], 1.0 - betas[1], eps]
                inputs += [stop, coefficients, gradients, parameters, averages, squares]
                launch_again(adam_update_kernel, ends[-1], inputs, device, BLOCK)


def _flat(tensor: Tensor) -> ArrayView:
    """A float32 tensor's numbers as an array."""
    return view(tensor, wp.float32)
