"""Before a training, on one device or several: the capture is read while torch is imported."""

import shlex
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from thermosplat.cli.arguments import with_measured
from thermosplat.cli.host_settings import importing
from thermosplat.errors import UserError

if TYPE_CHECKING:
    from thermosplat.config import TrainConfig
    from thermosplat.datasets.capture import Capture
    from thermosplat.training.trainer import Trainer


def check_capture_to_go_on_with(config: "TrainConfig") -> None:
    """Say how to name the capture of a resumed run that is no longer where it was."""
    from thermosplat.runs.run_directory import RunDirectory

    run = RunDirectory.open(str(config.resume))
    if config.data != "sample" and not Path(config.data).exists():
        raise UserError(
            f"The capture {config.data}, on which {run.path} was to go on, is not there.",
            f"Say where it lies now: thermosplat-train FOLDER --resume {shlex.quote(str(run.path))}",
        )


def capture_and_trainer(argv: list[str], config: "TrainConfig") -> tuple["TrainConfig", "Capture", type["Trainer"]]:
    """What to train with, on and by: images are read while torch and the trainer are imported.

    Returns:
        The configuration, with what the images of a run that begins recommend where the command says nothing else; the
        capture; and the trainer's class.
    """
    with importing():
        from thermosplat.datasets import capture_of  # takes no torch

    with ThreadPoolExecutor(max_workers=1) as thread:
        reading = thread.submit(capture_of, config)
        with importing():
            from thermosplat.prepare.checking.findings import recommended_by
            from thermosplat.prepare.checking.quick_check import quick_findings
            from thermosplat.training.trainer import Trainer

        capture = reading.result()
        if config.resume is None:  # a run that goes on was told when it began
            findings = quick_findings(capture, config.spectra, config.refine)
            capture = replace(capture, notes=(*capture.notes, *(one.sentence for one in findings)))
            config = with_measured(argv, config, recommended_by(findings))
        return config, capture, Trainer
