"""thermosplat-export: a trained run as PLY files for third-party viewers."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import run_program
from thermosplat.cli.run_arguments import RunArguments, SpectraArguments


@dataclass(frozen=True)
class ExportArguments(SpectraArguments, RunArguments):
    """Write a trained run's Gaussians as PLY, one file for each spectrum: splat_rgb.ply, splat_thermal.ply, ..."""

    output: str | None = None
    """Folder for the files. None: ply/ in the result folder."""
    compact: bool = False
    """Leave out spherical harmonics that are zero everywhere: files of decoded spectra shrink to a quarter. The
    original viewer wants all of them; many others do not."""


def main(argv: list[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: Arguments without the program's name. None: the process's.

    Returns:
        The exit code.
    """
    return run_program(ExportArguments, _export, argv, prog="thermosplat-export")


def _export(arguments: ExportArguments) -> int:
    with importing():
        from thermosplat.evaluation.loaded_run import load_run
        from thermosplat.export.scene import export_scene

    loaded = load_run(arguments.run, step=arguments.step, device="cpu")
    folder = loaded.directory.ply if arguments.output is None else Path(os.path.expanduser(arguments.output))
    written = export_scene(
        loaded.model,
        folder,
        scales=loaded.scales,
        spectra=arguments.chosen(list(loaded.model.spectra)),
        compact=arguments.compact,
    )
    for note in loaded.notes:
        print(note)
    for ply in written.values():
        dropped = f", {ply.num_dropped:,} invisible or broken ones left out" if ply.num_dropped else ""
        print(f"{ply.path}: {ply.num_gaussians:,} Gaussians{dropped}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
