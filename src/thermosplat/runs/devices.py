"""Which device a command runs on, and what to call it."""

import torch

from thermosplat.errors import UserError


def choose_device(name: str) -> torch.device:
    """The device of a ``--device`` flag.

    Args:
        name: "auto" (CUDA where there is a device, else the CPU), "cpu", "cuda" or "cuda:<index>".

    Raises:
        UserError: If there is no such device here.
    """
    if name == "auto":
        return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise UserError(f'--device must be "auto", "cpu", "cuda" or "cuda:1", found "{name}".') from error
    if device.type == "cpu":
        return torch.device("cpu")
    if device.type != "cuda":
        raise UserError(f'--device {name} is not supported: thermosplat runs on "cuda" and on "cpu".')
    if not torch.cuda.is_available():
        raise UserError(f"--device {name} was asked for, but torch finds no CUDA device.", "Use --device cpu.")
    index = torch.cuda.current_device() if device.index is None else device.index
    if index >= torch.cuda.device_count():
        raise UserError(
            f"--device {name} was asked for, but the last CUDA device here is cuda:{torch.cuda.device_count() - 1}."
        )
    return torch.device("cuda", index)


def device_name(device: torch.device) -> str:
    """What a device is called in reports, e.g. "NVIDIA H200" or "CPU, 2 threads"."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    threads = torch.get_num_threads()
    return f"CPU, {threads} thread{'s' if threads > 1 else ''}"
