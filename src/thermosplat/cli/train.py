"""thermosplat-train: from a capture to a trained scene, its numbers, pictures and files.

thermosplat-train sample                                  the capture that comes with the package, on two CPU cores
thermosplat-train data/shed                               a capture of one's own
thermosplat-train --resume results/shed/thermosplat_plus  go on after an interruption
thermosplat-train data/shed --devices 4                   on four GPUs; torchrun -m thermosplat train ... on hosts
"""

import contextlib
import io
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.errors import run_command
from thermosplat.cli.host_settings import importing, prepare_host, without_garbage_collection
from thermosplat.cli.training.beginning import capture_and_trainer, check_capture_to_go_on_with
from thermosplat.cli.training.devices import check_devices, devices_asked, train_on_devices
from thermosplat.cli.training.ending import say_what_and_where
from thermosplat.cli.viewer_flags import viewer_flags
from thermosplat.config.files import data_from_anywhere
from thermosplat.printing import print_last

if TYPE_CHECKING:
    from thermosplat.config import TrainConfig
    from thermosplat.datasets.capture import Capture
    from thermosplat.training.trainer import Trainer


def main(argv: list[str] | None = None) -> int:
    """Run the command with some words, or with the process's.

    Returns:
        The exit code: 0, 2 for a mistake of the user's, 130 after Ctrl-C, 143 after SIGTERM.
    """
    words = sys.argv[1:] if argv is None else argv
    if "RANK" in os.environ and os.environ.get("WORLD_SIZE", "1") not in ("", "1"):  # torchrun's
        from thermosplat.cli.training.divided_training import RankOfTraining

        return RankOfTraining(words).main()
    return run_command(lambda: _train_on_devices(words), debug="--debug" in words)


def _train_on_devices(argv: list[str]) -> int:
    """Train in this process, or start one for each device."""
    devices = devices_asked(argv)
    if devices is None or devices == 1:
        return _train(argv)
    with contextlib.redirect_stdout(io.StringIO()):  # rank 0 says the same again
        config = parse_train_arguments(argv)
    check_devices(devices, config.device)
    return train_on_devices(devices, argv)


def _train(argv: list[str]) -> int:
    config = parse_train_arguments(argv)  # before the heavy imports, so that --help and mistakes answer at once
    prepare_host()
    with without_garbage_collection():
        with importing():
            from thermosplat.rasterizer.warp_start import started_meanwhile

        with started_meanwhile(config):
            if config.resume is not None:
                check_capture_to_go_on_with(config)
            config, capture, trainer_class = capture_and_trainer(argv, config)
        make = _new_trainer if config.resume is None else _resumed_trainer
        trainer = make(config, capture, trainer_class)
    from thermosplat.cli.training.watched_training import watched
    from thermosplat.stop_signals import stopped_by_signals
    from thermosplat.training.session.interruption import TrainingInterrupted

    try:
        with stopped_by_signals(), trainer.run.locked():  # the signals again: pycolmap has been imported
            if config.resume is None:  # last, when nothing in the input can stop the run any more: it may delete here
                trainer.run.create(trainer.run.path, overwrite=config.overwrite)
            with watched(trainer, viewer_flags(argv)):
                metrics = trainer.train()
    except TrainingInterrupted as stop:
        print_last(
            f"Stopped at step {trainer.state.step:,}; saved {stop.checkpoint}.", f"Go on with: {stop.resume_command}"
        )
        return stop.exit_code
    say_what_and_where(trainer, metrics)
    return 0


def _new_trainer(config: "TrainConfig", capture: "Capture", trainer_class: type["Trainer"]) -> "Trainer":
    from thermosplat.runs.run_directory import RunDirectory

    folder = config.result_dir or str(Path("results") / capture.name / Path(config.config).stem)
    config = replace(config, data=data_from_anywhere(config.data), result_dir=folder, overwrite=False)
    return trainer_class(replace(config, batch_size=config.batch_size or 1), capture, RunDirectory(folder))


def _resumed_trainer(config: "TrainConfig", capture: "Capture", trainer_class: type["Trainer"]) -> "Trainer":
    from thermosplat.runs.run_directory import RunDirectory

    run = RunDirectory.open(str(config.resume))
    return trainer_class.resume(replace(config, data=data_from_anywhere(config.data), resume=None), capture, run)


if __name__ == "__main__":
    sys.exit(main())
