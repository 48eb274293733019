"""thermosplat-export --format ply, sog, ...: splats, fitted to the exact render."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from thermosplat.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor

    from thermosplat.cli.exporting.arguments import ExportArguments
    from thermosplat.datasets.frame_tensors import ViewTensors
    from thermosplat.evaluation.loaded_run import LoadedRun
    from thermosplat.export.scene import SceneSplats
    from thermosplat.novel_views.viewpoints import PathName


def export_splats(arguments: "ExportArguments", loaded: "LoadedRun", folder: Path) -> None:
    """Write the splats of the chosen spectra.

    Args:
        arguments: The command's; its format is one of splats.
        loaded: The run.
        folder: Where to write.

    Raises:
        UserError: The arguments, the capture or the format do not allow it.
    """
    from thermosplat.export.formats.splat_formats import SPLAT_FORMATS, Described, write_format
    from thermosplat.export.origin_file import write_origin
    from thermosplat.export.scene import spectrum_values, write_scene

    scene, sources = _scene(arguments, loaded)
    if arguments.format == "ply":
        scalars = None
        if arguments.values:
            measured = {name: unit for name in scene if (unit := loaded.scales[name].measured_unit) is not None}
            if not measured:
                raise UserError("No spectrum of this run has a unit, so nothing is measured.", "Leave --values out.")
            values = {
                f"scalar_{name}_{unit}": spectrum_values(loaded.model, name, loaded.scales)
                for name, unit in measured.items()
            }
            scalars = {name: {scalar: of_each[sources[name]] for scalar, of_each in values.items()} for name in scene}
        written = write_scene(scene, folder, compact=arguments.compact, scalars=scalars)
    else:
        format = next(name for name in SPLAT_FORMATS if name == arguments.format)
        written = {
            name: write_format(format, folder, Described(splats, name, comments))
            for name, (splats, comments) in scene.items()
        }
    for line in write_origin(folder, loaded.model.placement):
        print(line)
    for file in written.values():
        dropped = f", {file.num_dropped:,} invisible or broken ones left out" if file.num_dropped else ""
        size = file.path.stat().st_size / 1e6
        print(f"{file.path}: {file.num_gaussians:,} Gaussians, {size:.1f} MB{dropped}")


def _scene(arguments: "ExportArguments", loaded: "LoadedRun") -> "tuple[SceneSplats, dict[str, Tensor | slice]]":
    """The splats of the chosen spectra, fitted where there are decoders, and which Gaussians they are made of."""
    from thermosplat.export.scene import scene_splats

    names = arguments.chosen(list(loaded.model.spectra))
    if all(loaded.model.formations[name].exact_splats for name in names) or arguments.fit_passes == 0:
        unfitted = scene_splats(loaded.model, loaded.scales, names, colors=arguments.colors)
        return unfitted, dict.fromkeys(unfitted, slice(None))
    from thermosplat.cli.exporting.fit_progress import shown_steps
    from thermosplat.export.scene import header_comments
    from thermosplat.export.splat_fit.fitted_splats import fit_splats
    from thermosplat.export.splats import in_world
    from thermosplat.novel_views.viewpoints import viewpoints

    try:
        capture = loaded.capture(arguments.data)
    except UserError as error:
        raise UserError(error.message, f"{error.hint} Or export without a fit: --fit-passes 0.".strip()) from error
    for note in capture.notes:
        print(note)
    scene: SceneSplats = {}
    sources: dict[str, Tensor | slice] = {}
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
            progress=partial(shown_steps, name=name),
        )
        print(f"{name}: {fit.after:.2f} dB from the exact render, {fit.before:.2f} dB before the fit")
        sources[name] = fit.sources
        comments = header_comments(loaded.model, name, loaded.scales[name], colors=arguments.colors)
        scene[name] = (in_world(fit.splats, loaded.model.placement), comments)
    return scene, sources
