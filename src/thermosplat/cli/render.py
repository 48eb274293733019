"""thermosplat-render: a trained run along a camera path, as a video or as PNGs."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from thermosplat.cli.command_line import check_ranges
from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import program
from thermosplat.cli.recalculating import asked_temperatures
from thermosplat.cli.run_arguments import RunOnCaptureArguments, SpectraArguments
from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.errors import UserError
from thermosplat.printing import SafeConsole

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from thermosplat.novel_views.bookmarks import Bookmark
    from thermosplat.novel_views.viewpoints import PathName


@dataclass(frozen=True)
class RenderArguments(TemperatureSettings, SpectraArguments, RunOnCaptureArguments):
    """Render a trained run along a camera path: a video or PNGs of one spectrum, or of several side by side."""

    path: str = "interp"
    """interp: smoothly through the training views; ellipse: round the scene as far as cameras were; spiral: in front of
    it; train, test: the views of that split themselves. Or a bookmarks file of thermosplat-view: smoothly through its
    bookmarks."""
    format: Literal["mp4", "png"] = "mp4"
    """A video (H.264 after pip install ".[video]" in the repository), or a folder of PNGs, named by the frames on the
    train and test paths and numbered on the others. Beside PNGs the measured values lie as TIFFs of 32-bit floats."""
    layout: Literal["side-by-side", "wipe", "inset"] = "side-by-side"
    """Of several spectra: beside each other; a wipe whose edge wanders over the picture; or the others small inside
    the first."""
    color_bar: bool = False
    """Put the colour bar of each measured spectrum beside the picture, in its unit."""
    title: str = ""
    """One line above the picture."""
    frames: int = 120
    """Images along the path; the train and test paths have one for each view."""
    fps: int = 30
    """Images a second of the video."""


def _render(arguments: RenderArguments) -> int:
    check_ranges(arguments, frames=(1, 1_000_000), fps=(1, 1_000))
    with importing():
        from rich.progress import track

        from thermosplat.evaluation.held_out import file_stem
        from thermosplat.evaluation.loaded_run import load_run
        from thermosplat.evaluation.results_page import write_results_page
        from thermosplat.novel_views.viewpoints import bookmarked_viewpoints, rendered_images, viewpoints
        from thermosplat.pictures.image_display import write_values
        from thermosplat.pictures.layouts import check_title
        from thermosplat.pictures.video import browsers_play_videos, write_images
        from thermosplat.runs.atomic_writes import check_is_no_link
        from thermosplat.thermography.display_range import display_range

    path, bookmarks = _named_path(arguments.path)
    check_title(arguments.title)
    loaded = load_run(arguments.run, step=arguments.step, device=arguments.device)
    shown = arguments.chosen(list(loaded.model.spectra))
    capture = loaded.capture(arguments.data)
    for note in (*loaded.notes, *capture.notes):
        print(note)
    temperatures = asked_temperatures(arguments, loaded, capture)
    count, device = arguments.frames, loaded.device
    if path is None:
        points = bookmarked_viewpoints(capture, bookmarks, shown, num_frames=count, device=device)
    else:
        points = viewpoints(capture, path, shown, num_frames=count, device=device)
    layout = "" if arguments.layout == "side-by-side" else f"-{arguments.layout}"
    name = f"{path or 'bookmarks'}{layout}_{'-'.join(shown)}_{loaded.result_name(capture)}"
    name += "_recalculated" if temperatures.text else ""
    videos = loaded.directory.videos
    check_is_no_link(videos / name)
    names = [f"{index:05d}" for index in range(len(points))]
    if path in ("train", "test"):
        names = [file_stem(point.frame) for point in points]

    def write_measured(index: int, spectrum: str, values: "NDArray[np.float32]") -> None:
        write_values(videos / name / f"{names[index]}_{spectrum}.tiff", values)

    if arguments.format == "png":
        for earlier in (videos / name).glob("[0-9]" * 5 + "_*.tiff"):  # of a longer path
            earlier.unlink()
    images = rendered_images(
        loaded.model,
        points,
        sh_degree=loaded.sh_degree,
        scales=loaded.scales,
        layout=arguments.layout,
        color_bar=arguments.color_bar,
        title=arguments.title,
        temperatures=temperatures,
        ranges={name: display_range(capture, name) for name in shown},
        measured=write_measured if arguments.format == "png" else None,
    )
    console = SafeConsole()
    doing = f"Rendering {path or 'bookmarks'}"
    written = write_images(
        track(images, doing, len(points), console=console, transient=True, disable=not console.is_terminal),
        videos / name,
        format=arguments.format,
        fps=arguments.fps,
        names=names if path in ("train", "test") else None,
    )
    if arguments.format == "mp4" and written.is_dir():
        print("No video encoder here, so PNGs were written.")
    elif arguments.format == "mp4" and not browsers_play_videos():
        print(
            'The video is MPEG-4, which some browsers do not play. For H.264: pip install ".[video]" in the repository.'
        )
    write_results_page(loaded.directory)
    print(f"{len(points)} images: {written}")
    return 0


def _named_path(asked: str) -> "tuple[PathName | None, list[Bookmark]]":
    """The path of that name, or the bookmarks in the file of that name."""
    from thermosplat.novel_views.bookmarks import read_bookmarks
    from thermosplat.novel_views.viewpoints import PATHS

    path = next((name for name in PATHS if name == asked), None)
    if path is not None:
        return path, []
    file = Path(os.path.expanduser(asked))
    if not file.is_file():
        raise UserError(
            f"--path {asked} is neither a path nor a file.",
            f"Give one of {', '.join(PATHS)}, or a bookmarks file of thermosplat-view.",
        )
    return None, read_bookmarks(file)


main = program(RenderArguments, _render, prog="thermosplat-render")

if __name__ == "__main__":
    sys.exit(main())
