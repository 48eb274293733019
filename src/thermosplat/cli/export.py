"""thermosplat-export: a trained run as files for other programs."""

import os
import sys
from pathlib import Path

from thermosplat.cli.command_line import check_ranges
from thermosplat.cli.exporting.arguments import ExportArguments
from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import program
from thermosplat.errors import UserError

FLAGS_OF_FORMATS = (
    ("PLY", "ply", ("compact", "values")),
    ("maps", "orthomosaic", ("gsd", "extent", "top", "up")),
    ("meshes", "mesh", ("voxel",)),
)
"""What takes them, its --format, and the flags that nothing else takes."""


def _export(arguments: ExportArguments) -> int:
    anywhere = dict.fromkeys(("top", "extent", "up"), (-1e30, 1e30))
    check_ranges(arguments, points=(1, 1_000_000_000), fit_passes=(0, 1_000_000), **anywhere)
    for what, format, flags in FLAGS_OF_FORMATS:
        for flag in flags:
            if arguments.format != format and getattr(arguments, flag) not in (None, False):
                raise UserError(f"--{flag} is a setting of {what}, not of {arguments.format}.", "Leave it out.")
    holds_values = arguments.format in ("points", "mesh", "orthomosaic") or (
        arguments.format == "ply" and arguments.values
    )
    if arguments.any_given and not holds_values:
        flag = next(iter(arguments.given), "labels")
        raise UserError(
            f"--{flag} recalculates temperatures, and these files have colours alone.",
            "Give --format points, mesh or orthomosaic, or --format ply --values.",
        )

    with importing():
        from thermosplat.evaluation.loaded_run import load_run
        from thermosplat.evaluation.results_page import write_results_page

        if arguments.format == "orthomosaic":
            from thermosplat.cli.exporting.map import export_map as export
        elif arguments.format in ("points", "las", "mesh"):
            from thermosplat.cli.exporting.surface import export_surface as export
        elif arguments.format == "html":
            from thermosplat.cli.exporting.page import export_page as export
        else:
            from thermosplat.cli.exporting.splats import export_splats as export

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


main = program(ExportArguments, _export, prog="thermosplat-export")

if __name__ == "__main__":
    sys.exit(main())
