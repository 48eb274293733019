"""Adam that updates some rows of a parameter by a Warp kernel; parameter and moments may lie in the host's memory."""

import inspect
from collections import defaultdict
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.arrays import view
from thermosplat.torch_bridge.host_rows import on_cpu, paired, row_buffer, zero_pair
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.array_views import ArrayView, empty
from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.tensor_tables import BLOCK, addresses
from warp_kernels.training.adam import adam_coefficients_kernel
from warp_kernels.training.row_adam import LINE, THREADS, row_adam_kernel


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

    with t, the steps done, the same for all rows. With a ``weight_decay`` δ the old p is multiplied by 1 - r δ, as
    ``torch.optim.AdamW`` does. Other rows keep their numbers and their moments, which ``torch.optim.Adam`` would let
    decay and go on moving them by. A row that is first used late is treated as that of a Gaussian that was added late.
    Where every step uses all rows, the two are the same.

    The state and ``state_dict`` are ``torch.optim.Adam``'s. The rate ``lr`` must be a tensor on the parameter's device.

    Moments of the first ``rows_on_device`` rows lie on the device between steps, so that less crosses the bus. Whoever
    asks for ``state`` finds them in the host's memory: they are brought there, and fetched again by the next step.
    """

    # Torch's own, without what imports torch's compiler to hide them from it: a second of every start.
    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)

    rows: Rows | None = None
    """What the step under way has used; None: nothing, and there is no update."""
    rows_on_device: int = 0
    """Rows whose moments lie on the device, if there are as many and it has room for them."""
    near: Tensor | None = None
    """Moments of the first rows, on the device, float32 [R, 2 L] as in ``host_rows.Pair.buffer``."""

    @property
    def state(self) -> defaultdict[Tensor, Any]:
        """As every optimizer's."""
        self.bring_home()
        return self._state

    @state.setter
    def state(self, state: defaultdict[Tensor, Any]) -> None:
        self.near, self._state = None, state

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
        group, shape, length = self.param_groups[0], tuple(parameter.shape), parameter[0].numel()
        state = self._state[parameter]
        if not state:
            state["step"] = torch.zeros((), device=parameter.device)
            state["exp_avg"], state["exp_avg_sq"] = zero_pair(shape, parameter.device)
        moments = paired(state["exp_avg"], state["exp_avg_sq"], parameter.device)
        state["exp_avg"], state["exp_avg_sq"] = moments
        far, numbers = moments.buffer, row_buffer(parameter)
        if self.near is None:
            self.near = self._fetched(far)
        gradient = values if values.grad is None else values.grad.contiguous()  # None: there are no numbers
        number = len(indices)
        used = values.numel() // max(number, 1)
        betas, epsilon, stop = tuple(group["betas"]), group["eps"], _number(blocked)
        pairs = -(-used // (2 * LINE)) * LINE
        with launches_on_torch_stream(blocked.device) as device:
            steps, rates = addresses([_number(state["step"])]), addresses([_number(group["lr"])])
            coefficients = empty(1, wp.vec3, device)
            counted = [*betas, group["weight_decay"], rates, stop, steps, coefficients]
            launch_again(adam_coefficients_kernel, 1, counted, device)
            inputs = [pairs, used, length, 1.0 - betas[0], betas[1], 1.0 - betas[1], epsilon, stop, coefficients]
            inputs += [view(indices, wp.int64), view(values, wp.float32, number, used)]
            inputs += [view(gradient, wp.float32, number, used)]
            inputs += [view(self.near, wp.vec4, len(self.near), far.shape[1] // 4)]
            inputs += [view(far, wp.vec4, len(far), far.shape[1] // 4), view(numbers, wp.float32, *numbers.shape)]
            for first in range(0, number * pairs, THREADS):
                threads = min(THREADS, number * pairs - first)
                launch_again(row_adam_kernel, threads, [first, *inputs], device, BLOCK)

    def _fetched(self, far: Tensor) -> Tensor:
        """The first rows of a buffer of moments on the device; fewer where it has no room for all of them."""
        while True:
            number = min(self.rows_on_device, len(far))
            try:
                return torch.empty((number, far.shape[1]), device=far.device).copy_(far[:number])
            except torch.OutOfMemoryError:
                self.leave_more_room()

    @torch.no_grad()
    def bring_home(self) -> None:
        """Put all moments into the host's memory."""
        if self.near is None:
            return
        for state in self._state.values():  # of the one parameter
            moments = paired(state["exp_avg"], state["exp_avg_sq"], self.near.device)
            moments.buffer[: len(self.near)].copy_(self.near)
        self.near = None

    def leave_more_room(self) -> bool:
        """Have moments of half as many rows on the device from now on; of none where they are few.

        Returns:
            Whether there were any.
        """
        had, few = self.rows_on_device, len(self.parameter) // 16
        self.bring_home()
        self.rows_on_device = had // 2 if had // 2 > few else 0
        return had > 0

    def state_dict(self) -> dict[str, Any]:
        """As ``torch.optim.Adam``'s, with moments in ordinary tensors of the CPU: the device may have no room."""
        packed: dict[str, Any] = inspect.unwrap(torch.optim.Adam.state_dict)(self)
        states = {
            place: {key: value if key == "step" else on_cpu(value) for key, value in state.items()}
            for place, state in packed["state"].items()
        }
        return {**packed, "state": states}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over moments, into the host's memory; settings stay as they are.

        Args:
            state_dict: Of this class or of ``torch.optim.Adam``, of one parameter.
        """
        parameter = self.parameter
        self.state.clear()
        for given in state_dict["state"].values():
            state = {key: value.to(parameter.device) if value.dim() == 0 else value for key, value in given.items()}
            first, second = (state.get(key, parameter.new_empty(0)) for key in ("exp_avg", "exp_avg_sq"))
            if first.shape == second.shape == parameter.shape:  # else who asked for it refuses it
                state["exp_avg"], state["exp_avg_sq"] = paired(first, second, parameter.device)
            self.state[parameter] = state


def _number(tensor: Tensor) -> ArrayView:
    """A float32 scalar as an array."""
    return view(tensor, wp.float32)
