"""Commands of thermosplat as processes of a benchmark, so many at a time on every device."""

import json
import queue
from collections.abc import Sequence
from pathlib import Path

from thermosplat.method_matrix.processes import device_environment
from thermosplat.runs.run_directory import RunDirectory
from training.command import failure, run_python

COMMAND = "import sys; from thermosplat.cli.{program} import main; sys.exit(main())"


class Trainings:
    """Runs of thermosplat-train and its like, so many at a time.

    Args:
        devices: "cpu" or "cuda:<index>".
        at_once: trainings a device.
    """

    def __init__(self, devices: Sequence[str], at_once: int) -> None:
        self.count = len(devices) * at_once
        self._free: queue.Queue[str] = queue.Queue()
        for device in (*devices,) * at_once:
            self._free.put(device)

    def run(self, program: str, *words: str) -> None:
        """Runs a command to its end.

        Args:
            program: "train" or "evaluate".
            words: its arguments.

        Raises:
            RuntimeError: with the end of what the command wrote, if it failed.
        """
        device = self._free.get()
        try:
            arguments = ["-c", COMMAND.format(program=program), *words]
            done = run_python(arguments, device_environment(device, sharing=self.count))
        finally:
            self._free.put(device)
        if error := failure(done):
            raise RuntimeError(error)

    def train(self, folder: Path, *words: str) -> dict[str, float]:
        """Trains, and returns the held-out PSNR of each spectrum [dB].

        Raises:
            RuntimeError: with the end of what the command wrote, if it failed.
        """
        self.run("train", *words)
        metrics = json.loads(RunDirectory(folder).metrics_json.read_text(encoding="utf-8"))
        return {spectrum: metrics[spectrum]["psnr"] for spectrum in metrics["spectra"] if metrics[spectrum]}
