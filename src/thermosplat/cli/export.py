"""thermosplat-export: a trained run as files for other programs."""

import os
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import run_program
from thermosplat.cli.run_arguments import RunOnCaptureArguments, SpectraArguments
from thermosplat.errors import UserError

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors
    from thermosplat.evaluation.loaded_run import LoadedRun
    from thermosplat.export.scene import SceneSplats
    from thermosplat.novel_views.viewpoints import PathName


@dataclass(frozen=True)
class ExportArguments(SpectraArguments, RunOnCaptureArguments):
    """Write a trained run for other programs, one file for each spectrum: splat_rgb.ply, splat_thermal.ply, ..."""

    format: Literal["ply", "compressed-ply", "spz", "sog", "glb", "usd"] = "ply"
    """Splats: PLY of the original 3D Gaussian Splatting; PlayCanvas's compressed PLY and SOG; Niantic's SPZ; glTF with
    KHR_gaussian_splatting; OpenUSD (needs usd-core). docs/exports.md says which program opens which."""
    output: str | None = None
    """Folder for the files. None: in the result folder, ply/ for PLY and exports/ for the others."""
    fit_passes: int = 4
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


def main(argv: list[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: Arguments without the program's name. None: the process's.

    Returns:
        The exit code.
    """
    return run_program(ExportArguments, _export, argv, prog="thermosplat-export")


def _export(arguments: ExportArguments) -> int:
    if arguments.fit_passes < 0:
        raise UserError(f"--fit-passes must be at least 0, found {arguments.fit_passes}.")
    for flag in ("compact", "values"):
        if getattr(arguments, flag) and arguments.format != "ply":
            raise UserError(f"--{flag} is a setting of PLY, not of {arguments.format}.", "Leave it out.")

    with importing():
        from thermosplat.evaluation.loaded_run import load_run
        from thermosplat.export.formats import Described, write_format
        from thermosplat.export.scene import spectrum_values, write_scene

    loaded = load_run(arguments.run, step=arguments.step, device=arguments.device)
    folder = loaded.directory.ply if arguments.format == "ply" else loaded.directory.exports
    if arguments.output is not None:
        folder = Path(os.path.expanduser(arguments.output))
    scene = _scene(arguments, loaded)
    if arguments.format == "ply":
        scalars = None
        if arguments.values:
            measured = {name: unit for name in scene if (unit := loaded.scales[name].measured_unit) is not None}
            if not measured:
                raise UserError("No spectrum of this run has a unit, so nothing is measured.", "Leave --values out.")
            scalars = {
                f"scalar_{name}_{unit}": spectrum_values(loaded.model, name, loaded.scales)
                for name, unit in measured.items()
            }
        written = write_scene(scene, folder, compact=arguments.compact, scalars=scalars)
    else:
        antialiased = loaded.model.config.rasterize_mode == "antialiased"
        written = {
            name: write_format(arguments.format, folder, Described(splats, name, comments, antialiased))
            for name, (splats, comments) in scene.items()
        }
    for note in loaded.notes:
        print(note)
    for file in written.values():
        dropped = f", {file.num_dropped:,} invisible or broken ones left out" if file.num_dropped else ""
        size = file.path.stat().st_size / 1e6
        print(f"{file.path}: {file.num_gaussians:,} Gaussians, {size:.1f} MB{dropped}")
    return 0


def _scene(arguments: ExportArguments, loaded: "LoadedRun") -> "SceneSplats":
    """The splats of the chosen spectra, fitted where there are decoders."""
    from thermosplat.export.scene import scene_splats

    names = arguments.chosen(list(loaded.model.spectra))
    if loaded.model.decoders is None or arguments.fit_passes == 0:
        return scene_splats(loaded.model, loaded.scales, names, colors=arguments.colors)
    from rich.progress import track

    from thermosplat.export.fitted_colors import fit_splats
    from thermosplat.export.scene import header_comments
    from thermosplat.novel_views.viewpoints import viewpoints

    try:
        capture = loaded.capture(arguments.data)
    except UserError as error:
        raise UserError(error.message, f"{error.hint} Or export without a fit: --fit-passes 0.".strip()) from error
    for note in capture.notes:
        print(note)
    scene: SceneSplats = {}
    paths: tuple[PathName, PathName] = ("train", "test")
    for name in names:
        views: dict[PathName, list[ViewTensors]] = {}
        for path, frames in zip(paths, (capture.train, capture.test), strict=True):
            if any(name in frame.views for frame in frames):
                points = viewpoints(capture, path, [name], num_frames=1, device=loaded.device)
                views[path] = [point.views[name] for point in points]
        fit = fit_splats(
            loaded.model,
            name,
            loaded.scales[name],
            views.get("train", []),
            sh_degree=loaded.sh_degree,
            measured=views.get("test", []),
            colors=arguments.colors,
            passes=arguments.fit_passes,
            progress=partial(track, description=f"Fitting {name}", transient=True, disable=not sys.stdout.isatty()),
        )
        print(f"{name}: {fit.after:.2f} dB from the exact render, {fit.before:.2f} dB before the fit")
        scene[name] = (fit.splats, header_comments(loaded.model, name, loaded.scales[name], colors=arguments.colors))
    return scene


if __name__ == "__main__":
    sys.exit(main())
