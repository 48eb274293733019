"""thermosplat-export: a trained run as PLY files for third-party viewers."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import run_program
from thermosplat.cli.run_arguments import RunArguments


@dataclass(frozen=True)
class ExportArguments(RunArguments):
    """Write a trained run's Gaussians as PLY, one file for each spectrum: splat_rgb.ply and splat_thermal.ply."""

    modality: Literal["rgb", "thermal", "both"] | None = None
    """Which spectrum. None: all that were trained."""
    output: str | None = None
    """Folder for the files. None: ply/ in the result folder."""
    compact: bool = False
    """Leave out spherical harmonics that are zero everywhere: thermal files of decoded scenes shrink to a quarter. The
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
        from thermosplat.cli.loaded_run import load_run
        from thermosplat.export.scene import export_scene, modelled

    loaded = load_run(arguments.run, step=arguments.step, device="cpu")
    if arguments.modality is None:
        modalities = modelled(loaded.model)
    else:
        modalities = ("rgb", "thermal") if arguments.modality == "both" else (arguments.modality,)
    folder = loaded.directory.ply if arguments.output is None else Path(os.path.expanduser(arguments.output))
    written = export_scene(
        loaded.model, folder, thermal_scale=loaded.thermal_scale, modalities=modalities, compact=arguments.compact
    )
    for ply in written.values():
        dropped = f", {ply.num_dropped:,} invisible or broken ones left out" if ply.num_dropped else ""
        print(f"{ply.path}: {ply.num_gaussians:,} Gaussians{dropped}")
    return 0
