"""thermosplat-export: a trained run as files for other programs."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import run_program
from thermosplat.cli.run_arguments import RunOnCaptureArguments, SpectraArguments
from thermosplat.errors import UserError

FLAGS_OF_FORMATS = (
    ("PLY", "ply", ("compact", "values")),
    ("maps", "orthomosaic", ("gsd", "extent", "top", "up")),
    ("meshes", "mesh", ("voxel",)),
)
"""What takes them, its --format, and the flags that nothing else takes."""


@dataclass(frozen=True)
class ExportArguments(SpectraArguments, RunOnCaptureArguments):
    """Write a trained run for other programs, one file for each spectrum: splat_rgb.ply, splat_thermal.ply, ..."""

    format: Literal["ply", "compressed-ply", "spz", "sog", "glb", "usd", "points", "mesh", "orthomosaic"] = "ply"
    """Splats: PLY of the original 3D Gaussian Splatting; PlayCanvas's compressed PLY and SOG; Niantic's SPZ; glTF with
    KHR_gaussian_splatting; OpenUSD (needs usd-core). docs/exports.md says which program opens which. Surfaces
    from rendered depth with measured values, as PLY: points, mesh (needs scikit-image). A map from above:
    orthomosaic, a GeoTIFF of colours or of measured values (needs rasterio)."""
    output: str | None = None
    """Folder for the files. None: in the result folder, ply/ for PLY and exports/ for the others."""
    fit_passes: int = 10
    """How often each training view is seen while the splats' colours are fitted to what the decoders show. 0: each
    Gaussian gets the colour that its own features decode to. Scenes without decoders need no fit."""
    colors: Literal["palette", "scalar"] = "palette"
    """Spectra that are no photographs: in the colours of their palette, or their intensity from black to white."""
    compact: bool = False
    """PLY: leave out spherical harmonics that are zero everywhere. The original viewer wants all of them; many others
    do not."""
    values: bool = False
    """PLY: also write what each Gaussian measures, as scalar_<spectrum>_<unit>, which CloudCompare shows as a scalar
    field. Some viewers want the original properties and no more."""
    points: int = 1_000_000
    """Points: at most so many."""
    voxel: float | None = None
    """Mesh: side of a voxel [world units]. None: 1/256 of the scene's longest side."""
    gsd: float | None = None
    """Map: side of a pixel on the ground, in metres where the capture has GPS, else in world units. None: a thousandth
    of the map's longer side."""
    extent: tuple[float, float, float, float] | None = None
    """Map: west, south, east and north of what it shows. None: what the capture saw."""
    top: float | None = None
    """Map: height from which it is seen; what lies above is left out. None: the height of the highest camera."""
    up: tuple[float, float, float] | None = None
    """Map without GPS: what is up in the world. None: found by the cameras."""


def main(argv: list[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: Arguments without the program's name. None: the process's.

    Returns:
        The exit code.
    """
    return run_program(ExportArguments, _export, argv, prog="thermosplat-export")


def _export(arguments: ExportArguments) -> int:
    if arguments.points < 1:
        raise UserError(f"--points must be at least 1, found {arguments.points}.")
    if arguments.fit_passes < 0:
        raise UserError(f"--fit-passes must be at least 0, found {arguments.fit_passes}.")
    for what, format, flags in FLAGS_OF_FORMATS:
        for flag in flags:
            if arguments.format != format and getattr(arguments, flag) not in (None, False):
                raise UserError(f"--{flag} is a setting of {what}, not of {arguments.format}.", "Leave it out.")

    with importing():
        from thermosplat.evaluation.loaded_run import load_run
        from thermosplat.evaluation.results_page import write_results_page

        if arguments.format == "orthomosaic":
            from thermosplat.cli.export_map import export_map as export
        elif arguments.format in ("points", "mesh"):
            from thermosplat.cli.export_surface import export_surface as export
        else:
            from thermosplat.cli.export_splats import export_splats as export

    loaded = load_run(arguments.run, step=arguments.step, device=arguments.device)
    folder = loaded.directory.ply if arguments.format == "ply" else loaded.directory.exports
    if arguments.output is not None:
        folder = Path(os.path.expanduser(arguments.output))
    export(arguments, loaded, folder)
    if arguments.output is None:
        write_results_page(loaded.directory)
    for note in loaded.notes:
        print(note)
    return 0


if __name__ == "__main__":
    sys.exit(main())
