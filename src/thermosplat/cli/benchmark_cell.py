"""The process in which thermosplat-benchmark makes one cell: python -m thermosplat.cli.benchmark_cell."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from thermosplat.cli.errors import run_command
from thermosplat.cli.host_settings import importing
from thermosplat.config.files import load_config
from thermosplat.method_matrix.cells import Cell


@dataclass(frozen=True)
class CellArguments:
    """Train and measure one cell of thermosplat-benchmark."""

    folder: Path
    """The cell's run folder, with its configuration in cell.yaml."""
    scene: str
    """The scene's name."""
    method: str
    """The method's name."""
    seed: int
    """Seed of the training."""
    keep_checkpoint: bool = True
    """Keep the last checkpoint."""


def main(argv: list[str] | None = None) -> int:
    """Run the command with some words, or with the process's; the exit code."""
    arguments = tyro.cli(CellArguments, prog="benchmark_cell", args=sys.argv[1:] if argv is None else argv)
    return run_command(lambda: _make(arguments), debug=False, one_line=True)  # for ``Job.reason``


def _make(arguments: CellArguments) -> int:
    with importing():
        from thermosplat.method_matrix.cell_run import make_cell
        from thermosplat.rasterizer.warp_start import start_warp
        from thermosplat.stop_signals import stopped_by_signals
        from thermosplat.training.session.interruption import TrainingInterrupted

    start_warp()
    config = load_config(arguments.folder / "cell.yaml")
    cell = Cell(arguments.scene, arguments.method, arguments.seed)
    try:
        with stopped_by_signals():  # again: pycolmap has been imported
            make_cell(cell, config, arguments.folder, keep_checkpoint=arguments.keep_checkpoint)
    except TrainingInterrupted as stop:
        print(f"Interrupted; saved {stop.checkpoint}.")
        return stop.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
