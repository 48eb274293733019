"""Rows of a parameter that a step needs, fetched by a Warp kernel where the parameter lies in the host's memory."""

import torch
import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.arrays import view
from thermosplat.torch_bridge.host_rows import has_padded_rows, row_buffer
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.tensor_tables import BLOCK
from warp_kernels.training.row_fetch import QUAD, THREADS, row_fetch_kernel


@torch.no_grad()
def fetched_rows(values: Tensor, indices: Tensor, used: int | None = None) -> Tensor:
    """Rows of a tensor, on its device.

    Args:
        values: float32, [N, K, ...]; or [N, K].
        indices: Which rows, int64, [n].
        used: Of each row only so many of the K; None: all.

    Returns:
        [n, used, ...], without gaps.
    """
    values = values.detach()
    used = values.shape[1] if used is None else used
    if not has_padded_rows(values):
        return torch.index_select(values[:, :used], 0, indices)
    fetched = torch.empty((len(indices), used, *values.shape[2:]), device=values.device)
    if fetched.numel() > 0:
        rows, length = row_buffer(values), fetched[0].numel()
        quads = -(-length // QUAD)
        with launches_on_torch_stream(values.device) as device:
            arrays = [view(indices, wp.int64), view(rows, wp.float32, *rows.shape)]
            arrays.append(view(fetched, wp.float32, len(fetched), length))
            for first in range(0, len(fetched) * quads, THREADS):
                threads = min(THREADS, len(fetched) * quads - first)
                launch_again(row_fetch_kernel, threads, [first, quads, *arrays], device, BLOCK)
    return fetched
