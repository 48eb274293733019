"""thermosplat-train: from a capture to a trained scene, its numbers, pictures and files.

thermosplat-train sample                  the capture that comes with the package, minutes on two CPU cores
thermosplat-train data/shed               a capture of one's own
thermosplat-train --resume results/shed/thermosplat   go on after an interruption
"""

import shlex
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.errors import print_last, run_command
from thermosplat.cli.host_settings import importing, prepare_host, without_garbage_collection
from thermosplat.cli.viewer_flags import viewer_flags
from thermosplat.config.files import data_from_anywhere
from thermosplat.errors import UserError
from thermosplat.spectra import label

if TYPE_CHECKING:
    from thermosplat.config import TrainConfig
    from thermosplat.datasets.capture import Capture
    from thermosplat.training.trainer import Trainer


def main(argv: list[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: Arguments without the program's name. None: the process's.

    Returns:
        The exit code: 0, 2 for a mistake of the user's, 130 after Ctrl-C, 143 after SIGTERM.
    """
    words = sys.argv[1:] if argv is None else argv
    return run_command(lambda: _train(words), debug="--debug" in words)


def _train(argv: list[str]) -> int:
    config = parse_train_arguments(argv)  # before the heavy imports, so that --help and mistakes answer at once
    prepare_host()
    with without_garbage_collection():
        with importing():
            from thermosplat.rasterizer.warp_start import started_meanwhile

        with started_meanwhile(config):
            if config.resume is not None:
                _check_capture_to_go_on_with(config)
            capture, trainer_class = _capture_and_trainer(config)
        make = _new_trainer if config.resume is None else _resumed_trainer
        trainer = make(config, capture, trainer_class)
    from thermosplat.cli.watched_training import watched
    from thermosplat.training.session.interruption import TrainingInterrupted, stop_signals

    try:
        with stop_signals(), trainer.run.locked():  # the signals again: pycolmap has been imported
            if config.resume is None:  # last, when nothing in the input can stop the run any more: it may delete here
                trainer.run.create(trainer.run.path, overwrite=config.overwrite)
            with watched(trainer, viewer_flags(argv)):
                metrics = trainer.train()
    except TrainingInterrupted as stop:
        print_last(
            f"Stopped at step {trainer.state.step:,}; saved {stop.checkpoint}.\nGo on with: {stop.resume_command}"
        )
        return stop.exit_code
    _say_what_and_where(trainer, metrics)
    return 0


def _check_capture_to_go_on_with(config: "TrainConfig") -> None:
    """Say how to name the capture of a resumed run that is no longer where it was."""
    from thermosplat.runs.run_directory import RunDirectory

    run = RunDirectory.open(str(config.resume))
    if config.data != "sample" and not Path(config.data).exists():
        raise UserError(
            f"The capture {config.data}, on which {run.path} was to go on, is not there.",
            f"Say where it lies now: thermosplat-train FOLDER --resume {shlex.quote(str(run.path))}",
        )


def _capture_and_trainer(config: "TrainConfig") -> tuple["Capture", type["Trainer"]]:
    """The capture, and the trainer's class: images are read while torch and the trainer are imported."""
    with importing():
        from thermosplat.datasets import load_capture  # takes no torch

    with ThreadPoolExecutor(max_workers=1) as thread:
        reading = thread.submit(
            load_capture,
            config.data,
            data_factor=config.data_factor,
            test_every=config.test_every,
            spectra=config.spectra,
        )
        with importing():
            from thermosplat.prepare.quick_check import quick_notes
            from thermosplat.training.trainer import Trainer

        capture = reading.result()
        return replace(capture, notes=(*capture.notes, *quick_notes(capture, config.spectra))), Trainer


def _new_trainer(config: "TrainConfig", capture: "Capture", trainer_class: type["Trainer"]) -> "Trainer":
    from thermosplat.runs.run_directory import RunDirectory

    folder = config.result_dir or str(Path("results") / capture.name / Path(config.config).stem)
    config = replace(config, data=data_from_anywhere(config.data), result_dir=folder, overwrite=False)
    return trainer_class(config, capture, RunDirectory(folder))


def _resumed_trainer(config: "TrainConfig", capture: "Capture", trainer_class: type["Trainer"]) -> "Trainer":
    from thermosplat.runs.run_directory import RunDirectory

    run = RunDirectory.open(str(config.resume))
    return trainer_class.resume(replace(config, data=data_from_anywhere(config.data), resume=None), capture, run)


def _say_what_and_where(trainer: "Trainer", metrics: dict[str, Any]) -> None:
    """How large the model is, with what a budget has left of it, and what the run left behind."""
    from thermosplat.evaluation.held_out_poses import unrefined_sentences
    from thermosplat.evaluation.results_page import write_results_page
    from thermosplat.refinement.camera_report import correction_sentences

    size = [f"{metrics['num_gaussians']:,} Gaussians"]
    if trainer.budget is not None and metrics["feature_channels"] is not None:
        size.append(f"{metrics['feature_channels']} of {trainer.config.model.feature_dim} latent channels")
    for name, kept in metrics["opacity_offsets_kept"].items() if trainer.budget is not None else ():
        size.append(f"{kept:.0%} of the {label(name)} offsets")
    print(f"Model: {', '.join(size)}; {metrics['model_bytes'] / 1e6:.1f} MB.")
    for sentence in (*unrefined_sentences(metrics), *correction_sentences(metrics.get("refined", {}))):
        print(sentence)
    run = trainer.run
    pictures = len(list(run.renders.glob("*.png")))
    page = write_results_page(run)
    print(f"Results in {run.path}:")
    if page is not None:
        print(f"  {page.name:<14} numbers, plots and pictures on one page: open it in a browser")
    print(f"  {run.metrics_json.name:<14} the numbers; config.yaml reproduces the run")
    print(f"  {'renders/':<14} {pictures} held-out frames: ground truth | render | error")
    if "refined" in metrics:
        print(f"  {'refined/':<14} the refined cameras, as a COLMAP model of the undistorted images")
    for ply in sorted(run.ply.glob("*.ply")):
        print(f"  ply/{ply.name:<18} opens in third-party splat viewers")
    print(f"A video of it: thermosplat-render {shlex.quote(str(run.path))}")


if __name__ == "__main__":
    sys.exit(main())
