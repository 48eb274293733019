"""gsplat's ``SelectiveAdam``: Adam that updates what was seen, by one Warp kernel for each parameter."""

from collections.abc import Iterable
from typing import Any, cast

import torch
import warp as wp
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.torch_bridge.arrays import LONGEST, kinds_of, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.launching import launch
from warp_kernels.training.selective_adam import selective_adam_kernel


class SelectiveAdam(torch.optim.Adam):
    """Adam whose steps update the rows of the Gaussians that were seen; gsplat's optimizer, on the CPU too.

    The others keep their numbers and their moments. As in gsplat, and in the code of Taming 3DGS, moments are not
    corrected for having begun at zero. Takes the place of ``gsplat.optimizers.SelectiveAdam``.

    Args:
        params: Parameters [N, ...], or groups of one parameter each; float32 or float64.
        eps: Added to the denominator.
        betas: Decay of the moments.

    Example:
        >>> import torch
        >>> from thermosplat import SelectiveAdam
        >>> means = torch.zeros(3, 3, requires_grad=True)
        >>> optimizer = SelectiveAdam([{"params": [means], "lr": 0.1}], eps=1e-15, betas=(0.9, 0.999))
        >>> (means - 1).square().sum().backward()
        >>> optimizer.step(visibility=torch.tensor([True, False, True]))
        >>> means[:, 0].tolist()[1]
        0.0
    """

    def __init__(self, params: Iterable[Any], eps: float, betas: tuple[float, float]) -> None:
        super().__init__(params, eps=eps, betas=betas)

    @torch.no_grad()
    def step(self, visibility: Tensor) -> None:  # type: ignore[override]
        """Apply the gradients.

        Args:
            visibility: Which Gaussians were seen, [N]; bool, or not 0.

        Raises:
            UserError: A parameter has another number of rows, or another type.
        """
        visible = (visibility != 0).contiguous()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None and parameter.numel() > 0:
                    self._update(parameter, visible, group)

    def _update(self, parameter: Tensor, visible: Tensor, group: dict[str, Any]) -> None:
        if visible.shape != parameter.shape[:1]:
            raise UserError(
                f"visibility must have shape {[len(parameter)]}, a value for each row of a parameter "
                f"{list(parameter.shape)}, got {list(visible.shape)}."
            )
        if parameter.dtype not in (torch.float32, torch.float64) or not parameter.is_contiguous():
            raise UserError(f"SelectiveAdam takes contiguous float32 and float64 parameters, got {parameter.dtype}.")
        state = self.state[parameter]
        if len(state) == 0:
            state["step"] = torch.tensor(0.0)  # as torch's Adam and gsplat have it; nothing reads it
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        gradient = cast("Tensor", parameter.grad)
        dense = gradient.to_dense() if gradient.is_sparse else gradient.contiguous()
        numbers = (parameter, dense, state["exp_avg"], state["exp_avg_sq"])
        rows = max(1, LONGEST // parameter[0].numel())
        scalar, (beta1, beta2) = kinds_of(parameter.dtype).scalar, group["betas"]
        settings = [parameter[0].numel(), float(group["lr"]), 1.0 - beta1, 1.0 - beta2, group["eps"]]
        with launches_on_torch_stream(parameter.device) as device:
            for parts in zip(visible.split(rows), *(one.split(rows) for one in numbers), strict=True):
                seen, updated, *others = (view(part, kind) for part, kind in zip(parts, (wp.bool, *[scalar] * 4)))
                gradients, *moments = others
                inputs = [*settings, seen, gradients, updated, *moments]
                launch(selective_adam_kernel(scalar), updated.shape[0], inputs, device)
