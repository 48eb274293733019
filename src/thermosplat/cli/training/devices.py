"""``thermosplat-train --devices N``: one process for each device of this machine, as torchrun starts them.

The processes end together: they tell each other (``distributed.lifeline``), and what is left after a while is killed.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from types import FrameType

from thermosplat.cli.errors import print_error
from thermosplat.cli.flag_values import last_value
from thermosplat.cli.host_settings import importing
from thermosplat.errors import UserError
from thermosplat.stop_signals import STOP_SIGNALS, handled_signals

FLAG = "--devices"
PARENT = "THERMOSPLAT_PARENT"
"""The environment of the processes that ``--devices`` starts names their parent by it."""
GRACE = 20.0
"""Time that the other processes have to end after the first one that failed [s]: a checkpoint may be under way."""
TELLING = 3.0
"""Time in which the others end by themselves, where they have met [s]: those that wait to meet are ended then."""
_POLL = 0.05


def devices_asked(argv: list[str]) -> int | None:
    """What a command line says of ``--devices``; None: nothing, or this process is one of several already.

    Raises:
        UserError: It is no number of devices.
    """
    if "RANK" in os.environ:
        return None
    asked = last_value(argv, FLAG)
    if asked is None or asked == "None":
        return None
    if not re.fullmatch(r"[1-9]\d{0,3}", asked):
        raise UserError(f"{FLAG} must be a number of devices, found {asked!r}.", f"For two: {FLAG} 2")
    return int(asked)


def check_devices(devices: int, device: str) -> None:
    """Refuse more devices than there are, before a process is started for each.

    Args:
        device: What ``--device`` says.

    Raises:
        UserError: This machine has fewer GPUs, or ``--device`` names one.
    """
    with importing():
        import torch

    if device == "cpu" or (device == "auto" and not torch.cuda.is_available()):
        return
    if device not in ("auto", "cuda"):
        raise UserError(f"--device {device} names one device, and {FLAG} asks for {devices}.", "Give one of them.")
    found = torch.cuda.device_count()
    if devices > found:
        raise UserError(
            f"{FLAG} {devices} asks for more GPUs than the {found} of this machine.",
            f"Give {FLAG} {max(found, 1)}, or --device cpu for processes without a GPU.",
        )


def train_on_devices(devices: int, argv: list[str]) -> int:
    """Start the processes of a training, and wait for their end.

    Returns:
        The exit code: 0 where all ended well; else that of the first one that did not.
    """
    threads = str(max((os.cpu_count() or 1) // devices, 1))
    shared = {
        "WORLD_SIZE": str(devices),
        "LOCAL_WORLD_SIZE": str(devices),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(_free_port()),
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", threads),
        PARENT: str(os.getpid()),
    }
    command = [sys.executable, "-P", "-m", "thermosplat", "train", *argv]
    processes: list[subprocess.Popen[bytes]] = []

    def pass_on(number: int, frame: FrameType | None) -> None:
        for process in processes:
            if process.poll() is None:
                process.send_signal(number)

    with handled_signals(pass_on):
        try:
            for rank in range(devices):
                of_rank = {"RANK": str(rank), "LOCAL_RANK": str(rank)}
                processes.append(subprocess.Popen(command, env={**os.environ, **shared, **of_rank}))
            return _wait(processes)
        finally:
            for process in processes:
                if process.poll() is None:
                    process.kill()
                    process.wait()


def _wait(processes: "list[subprocess.Popen[bytes]]") -> int:
    failed, failed_at, asked = "", 0.0, False
    while None in (codes := [process.poll() for process in processes]):
        if any(codes):
            failed_at = failed_at or time.monotonic()
            failed = failed or _failure(codes)
            waited = time.monotonic() - failed_at
            if waited > TELLING and not asked:
                asked = True
                for process in processes:
                    if process.poll() is None:
                        process.terminate()
            if waited > GRACE:
                break
        time.sleep(_POLL)
    if asked and any(code in (None, -signal.SIGTERM) for code in codes):
        print_error(
            f"{failed} before it had met the others, which are ended now.",
            "What it wrote above, if anything, says why. Start the training again.",
        )
        return 2
    if all((code or 0) <= 0 for code in codes):  # nobody who was left had to tell of a death
        if codes[0] == 0:
            return 0  # rank 0 has written everything
        if any(code < 0 and -code not in STOP_SIGNALS for code in codes if code):
            print_error(f"{_failure(codes)} at its end: some of the results may be missing.", "Go on with --resume.")
    return max(_exit_code(code or 0) for code in codes)


def _failure(codes: list[int | None]) -> str:
    """Which process failed first, and how, of the codes at that moment."""
    rank, code = next((rank, code) for rank, code in enumerate(codes) if code)
    how = f"ended with code {code}" if code > 0 else f"was killed by {signal.Signals(-code).name}"
    return f"Rank {rank} of {len(codes)} {how}"


def _exit_code(code: int) -> int:
    """A process's as a shell has it; of one that was killed 2, as the others end with that."""
    return code if code >= 0 else 128 - code if -code in STOP_SIGNALS else 2


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]
