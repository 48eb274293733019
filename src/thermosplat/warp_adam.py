"""Adam whose update of a CUDA parameter is one Warp kernel; elsewhere torch's own."""

from typing import Any

import torch

from thermosplat.warp_bridge import SCALARS, wrap
from thermosplat.warp_streams import on_torch_stream
from warp_kernels.adam import adam_update


class WarpAdam(torch.optim.Adam):
    """``torch.optim.Adam`` with the same state and, to rounding, the same update. Never waits for the device.

    Its rate ``lr`` must be a tensor on the parameters' device, so that a captured step sees it change.
    """

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Apply the gradients, unless ``found_inf`` (set from outside, as by torch.amp.GradScaler) is not 0.

        Args:
            closure: Not supported; torch's signature has it.
        """
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None or parameter.numel() == 0:
                    continue
                state = self.state[parameter]
                if not state:
                    state["step"] = torch.zeros((), device=parameter.device)
                    state["exp_avg"] = torch.zeros_like(parameter)
                    state["exp_avg_sq"] = torch.zeros_like(parameter)
                tensors = (
                    parameter,
                    parameter.grad.contiguous(),
                    state["exp_avg"],
                    state["exp_avg_sq"],
                    state["step"],
                    group["lr"],
                    self.found_inf,  # type: ignore[attr-defined]
                )
                with on_torch_stream(parameter.device):
                    arrays = [wrap(tensor.view(-1), SCALARS[tensor.dtype]) for tensor in tensors]
                    adam_update(*arrays, group["betas"], group["eps"])
