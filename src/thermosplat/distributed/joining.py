"""How a process becomes one of several ranks: by the environment that torchrun gives it."""

import os
import signal
from datetime import timedelta

import torch
import torch.distributed as dist

from thermosplat.distributed.team import Team
from thermosplat.errors import UserError
from thermosplat.stop_signals import handled_signals

PATIENCE = timedelta(days=1)
"""How long a rank waits for another one that lives: rank 0 may evaluate for hours. The lifeline tells of those that do
not live any more."""


def join_team(device: str) -> Team:
    """Meet the other ranks, and take this rank's device.

    Args:
        device: As of ``--device``; "auto" and "cuda" give each rank a GPU of its own.

    Raises:
        UserError: There is no device for this rank, or one device is asked for by its number.
    """
    rank, size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    own = _device(device, int(os.environ.get("LOCAL_RANK", rank)))
    if own.type == "cuda":
        torch.cuda.set_device(own)
    backend = "cpu:gloo,cuda:nccl" if own.type == "cuda" else "gloo"
    # a wait in C++, where no handler of Python's is called: signals end the process, which has nothing yet
    with handled_signals(signal.SIG_DFL):
        dist.init_process_group(backend, rank=rank, world_size=size, timeout=PATIENCE)
    return Team(rank, size, own)


def _device(name: str, local_rank: int) -> torch.device:
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if name not in ("auto", "cuda"):
        raise UserError(f"--device {name} names one device, and this training has several.", "Leave --device out.")
    found = torch.cuda.device_count()
    if local_rank >= found:
        raise UserError(
            f"This host has {found} CUDA device{'' if found == 1 else 's'}, and rank {local_rank} of it needs its own.",
            "Start as many processes per host as it has devices: --devices or --nproc-per-node.",
        )
    return torch.device("cuda", local_rank)
