"""thermosplat-export --format ply, sog, ...: splats, fitted to the exact render."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from thermosplat.cli.recalculating import asked_temperatures
from thermosplat.errors import UserError
from thermosplat.printing import SafeConsole

if TYPE_CHECKING:
    from torch import Tensor

    from thermosplat.cli.exporting.arguments import ExportArguments
    from thermosplat.datasets.frame_tensors import ViewTensors
    from thermosplat.evaluation.loaded_run import LoadedRun
    from thermosplat.export.export_frame import ExportFrame
    from thermosplat.export.scene import Colors, SceneSplats
    from thermosplat.novel_views.viewpoints import PathName


LINE_EVERY = 10.0
"""Seconds between lines of a fit's progress."""


def export_splats(arguments: "ExportArguments", loaded: "LoadedRun", folder: Path) -> None:
    """Write the splats of the chosen spectra.

    Raises:
        UserError: The arguments, the capture or the format do not allow it.
    """
    from thermosplat.export.export_frame import ExportFrame
    from thermosplat.export.formats.splat_formats import SPLAT_FORMATS, Described, write_format
    from thermosplat.export.scene import write_scene

    frame = ExportFrame(loaded.model.placement, loaded.geo)
    scene, sources = fitted_scene(arguments, loaded, frame, colors=arguments.colors)
    if arguments.format == "ply":
        scalars = None
        if arguments.values:
            measured = {name: unit for name in scene if (unit := loaded.scales[name].measured_unit) is not None}
            if not measured:
                raise UserError("No spectrum of this run has a unit, so nothing is measured.", "Leave --values out.")
            values = _values(arguments, loaded, measured)
            scalars = {name: {scalar: of_each[sources[name]] for scalar, of_each in values.items()} for name in scene}
        written = write_scene(scene, folder, compact=arguments.compact, scalars=scalars, frame=frame)
    else:
        format = next(name for name in SPLAT_FORMATS if name == arguments.format)
        written = {
            name: write_format(format, folder, Described(splats, name, comments))
            for name, (splats, comments) in scene.items()
        }
    for line in frame.write(folder):
        print(line)
    for file in written.values():
        dropped = f", {file.num_dropped:,} invisible or broken ones left out" if file.num_dropped else ""
        size = file.path.stat().st_size / 1e6
        print(f"{file.path}: {file.num_gaussians:,} Gaussians, {size:.1f} MB{dropped}")


def _values(arguments: "ExportArguments", loaded: "LoadedRun", measured: dict[str, str]) -> "dict[str, Tensor]":
    """What each Gaussian measures, by the name of the property; recalculated over its way to the nearest camera."""
    import numpy as np
    import torch

    from thermosplat.export.scene import spectrum_values
    from thermosplat.export.surfaces.depth_views import RECALCULATED
    from thermosplat.thermography.scene_temperatures import Surroundings

    capture = loaded.capture(arguments.data) if arguments.any_given else None
    temperatures = asked_temperatures(arguments, loaded, capture)
    values: "dict[str, Tensor]" = {}
    for name, unit in measured.items():
        around = Surroundings(None, None)
        if capture is not None and temperatures.metres_per_unit is not None:
            views = [frame.views[name].viewmat for frame in capture.train if name in frame.views]
            centers = torch.as_tensor(np.linalg.inv(np.stack(views))[:, :3, 3], dtype=torch.float32)
            means = loaded.model.gaussians(loaded.model.set_of(name)).means.detach().cpu()
            nearest = torch.stack([(means - center).norm(dim=1) for center in centers]).amin(dim=0)
            unit_length = loaded.model.placement.unit * temperatures.metres_per_unit
            around = Surroundings(unit_length * nearest.double().numpy(), None)
        made = temperatures.recalculated(name, spectrum_values(loaded.model, name, loaded.scales), around)
        values[f"scalar_{name}_{unit}"] = made.values
        if made.changed is not None:
            values[f"scalar_{name}_{RECALCULATED}"] = torch.as_tensor(made.changed).float().to(made.values.device)
    return values


def fitted_scene(
    arguments: "ExportArguments", loaded: "LoadedRun", frame: "ExportFrame", *, colors: "Colors"
) -> "tuple[SceneSplats, dict[str, Tensor | slice]]":
    """The splats of the chosen spectra, fitted where there are decoders, and which Gaussians they are made of.

    Raises:
        UserError: There is no capture to fit to, or no such spectrum.
    """
    from thermosplat.export.scene import scene_splats

    names = arguments.chosen(list(loaded.model.spectra))
    exact = all(loaded.model.formations[name].exact_splats for name in names)
    # pseudo-colours become the values that they stand for by a fit alone
    becomes_values = colors == "scalar" and any(loaded.scales[name].kind == "color" for name in names)
    if (exact and not becomes_values) or arguments.fit_passes == 0:
        unfitted = scene_splats(loaded.model, loaded.scales, names, colors=colors, frame=frame)
        return unfitted, dict.fromkeys(unfitted, slice(None))
    from thermosplat.export.scene import header_comments
    from thermosplat.export.splat_fit.fitted_splats import fit_splats
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
            colors=colors,
            passes=arguments.fit_passes,
            progress=partial(shown_steps, name=name),
        )
        print(f"{name}: {fit.after:.2f} dB from the exact render, {fit.before:.2f} dB before the fit")
        sources[name] = fit.sources
        comments = header_comments(loaded.model, name, loaded.scales[name], frame, colors=colors)
        scene[name] = (frame.splats(fit.splats), comments)
    return scene, sources


def shown_steps(steps: Sequence[int], name: str, *, clock: Callable[[], float] = time.monotonic) -> Iterable[int]:
    """Steps to be done one after the other, shown to whoever waits for them."""
    console = SafeConsole()
    if not console.is_terminal:
        return _with_lines(steps, name, clock)
    from rich.progress import track

    return track(steps, f"Fitting {name}", console=console, transient=True)


def _with_lines(steps: Sequence[int], name: str, clock: Callable[[], float]) -> Iterator[int]:
    started = said = clock()
    for done, step in enumerate(steps):
        if clock() >= said + LINE_EVERY:
            said = clock()
            print(f"Fitting {name}: step {done:,} of {len(steps):,} after {said - started:.0f} s", flush=True)
        yield step
