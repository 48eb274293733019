"""Adam that updates some rows of a parameter by a Warp kernel; parameter and moments may lie in the host's memory."""

import inspect
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.arrays import view
from thermosplat.torch_bridge.host_memory import host_empty, in_host_memory
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.training.row_adam import RowAdamArrays, row_adam_update


class Rows(NamedTuple):
    """Rows of a parameter [N, ...] that a step has used."""

    indices: Tensor
    """Which, each once, int64, shape [n]."""
    values: Tensor
    """A leaf of autograd that holds them, with their gradient; shape [n, ...]. Of a parameter [N, K, 3] it may be the
    first coefficients alone, [n, k, 3], while the others have never had a gradient. One without numbers may have no
    gradient."""


class RowAdam(torch.optim.Adam):
    """Adam of one parameter whose steps have gradients of some rows; its moments lie in the host's memory.

    The update of these rows is ``torch.optim.Adam``'s, to rounding:

        m ← β1 m + (1 - β1) g,  v ← β2 v + (1 - β2) g²,  p ← p - r / (1 - β1ᵗ) · m / (√v / √(1 - β2ᵗ) + ε)

    with t, the steps done, the same for all rows. Other rows keep their numbers and their moments, which
    ``torch.optim.Adam`` would let decay and go on moving them by. A row that is first used late is treated as that of a
    Gaussian that was added late. Where every step uses all rows, the two are the same.

    The state and ``state_dict`` are ``torch.optim.Adam``'s. The rate ``lr`` must be a tensor on the parameter's device.
    """

    # Torch's own, without what imports torch's compiler to hide them from it: a second of every start.
    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)

    rows: Rows | None = None
    """What the step under way has used; None: nothing, and there is no update."""

    @property
    def parameter(self) -> Tensor:
        """The parameter."""
        found: Tensor = self.param_groups[0]["params"][0]
        return found

    @torch.no_grad()
    def step_rows(self, blocked: Tensor) -> None:
        """Apply the gradients of ``rows``, if there are any.

        Args:
            blocked: float32 scalar on the parameter's device; not 0: leave everything as it is.
        """
        if self.rows is None:
            return
        parameter, (indices, values) = self.parameter, self.rows
        state, group = self.state[parameter], self.param_groups[0]
        if not state:
            state["step"] = torch.zeros((), device=parameter.device)
            for key in ("exp_avg", "exp_avg_sq"):
                state[key] = host_empty(tuple(parameter.shape), parameter.device).zero_()
        gradient = values if values.grad is None else values.grad.contiguous()  # None: there are no numbers
        number, length = len(indices), parameter[0].numel()
        used = values.numel() // max(number, 1)
        with launches_on_torch_stream(blocked.device):
            arrays = RowAdamArrays(
                indices=view(indices, wp.int64),
                values=view(values, wp.float32, number, used),
                gradient=view(gradient, wp.float32, number, used),
                parameter=view(parameter, wp.float32, len(parameter), length),
                exp_avg=view(state["exp_avg"], wp.float32, len(parameter), length),
                exp_avg_sq=view(state["exp_avg_sq"], wp.float32, len(parameter), length),
                step=_number(state["step"]),
                rate=_number(group["lr"]),
            )
            row_adam_update(arrays, _number(blocked), tuple(group["betas"]), group["eps"])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over moments, into the host's memory; settings stay as they are.

        Args:
            state_dict: Of this class or of ``torch.optim.Adam``, of one parameter.
        """
        device = self.parameter.device
        self.state.clear()
        for moments in state_dict["state"].values():
            self.state[self.parameter] = {
                key: value.to(device) if value.dim() == 0 else in_host_memory(value, device)
                for key, value in moments.items()
            }


def _number(tensor: Tensor) -> ArrayView:
    """A float32 scalar as an array."""
    return view(tensor, wp.float32)
