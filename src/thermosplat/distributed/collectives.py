"""What ranks tell each other, of numbers and rows of tensors; every rank makes the same calls in the same order.

NCCL carries tensors of CUDA devices and gloo those of the CPU. W is the number of ranks.
"""

from collections.abc import Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.errors import UserError


def check_is_joined() -> None:
    """Refuse to work with others before the process has joined them.

    Raises:
        UserError: No process group was made.
    """
    if not (dist.is_available() and dist.is_initialized()):
        raise UserError(
            "distributed=True needs a process group, and this process has joined none.",
            "Call torch.distributed.init_process_group() first, in processes that torchrun starts.",
        )


def numbers_of_all(numbers: Sequence[float], device: torch.device) -> list[list[float]]:
    """Every rank's numbers, by rank.

    They travel from host to host, so that no rank waits for its GPU. A process group without a backend for the CPU
    takes them over the device, and waits for it.

    Args:
        numbers: This rank's, exact in float64; as many on every rank.
    """
    hosts_talk = "cpu:" in dist.get_backend_config()
    own = torch.tensor(list(numbers), dtype=torch.float64, device="cpu" if hosts_talk else device)
    return [numbers_of_rank.tolist() for numbers_of_rank in tensors_of_all(own)]


def tensors_of_all(own: Tensor) -> list[Tensor]:
    """Every rank's tensor, by rank; all have one shape."""
    own = own.contiguous()
    gathered = [torch.empty_like(own) for _ in range(dist.get_world_size())]
    dist.all_gather(gathered, own)
    return gathered


def exchanged_rows(rows: Tensor, sent: Sequence[int], received: Sequence[int]) -> Tensor:
    """Rows [n, X] for each rank, sent there; those that the others had for this one, [m, X], by rank.

    Args:
        rows: Those for rank 0 first.
        sent: Rows for each rank; n in all.
        received: Rows from each rank; m in all.
    """
    arrived = rows.new_empty(sum(received), *rows.shape[1:])
    if rows.shape[1:].numel() == 0:
        return arrived
    dist.all_to_all_single(arrived, rows.contiguous(), list(received), list(sent))
    return arrived


class GatheredRows(torch.autograd.Function):
    """Rows [n, ...] of all ranks, rank 0's first, whose gradients travel back to where each row came from."""

    @staticmethod
    def forward(ctx: Any, own: Tensor, counts: Sequence[int]) -> Tensor:
        """All rows.

        Args:
            counts: Rows of each rank.
        """
        rank, longest = dist.get_rank(), max(counts)
        ctx.start, ctx.count = sum(counts[:rank]), counts[rank]
        padded = own.new_zeros(longest, *own.shape[1:])
        padded[: len(own)] = own
        return torch.cat([rows[:count] for rows, count in zip(tensors_of_all(padded), counts, strict=True)])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_all: Tensor) -> tuple[Tensor, None]:
        """The sum over all ranks of the gradients to this rank's rows."""
        total = v_all.clone(memory_format=torch.contiguous_format)
        dist.all_reduce(total)
        return total[ctx.start : ctx.start + ctx.count], None
