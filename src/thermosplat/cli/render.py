"""thermosplat-render: a trained run along a camera path, as a video or as PNGs."""

import sys
from dataclasses import dataclass
from typing import Literal

from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import run_program
from thermosplat.cli.run_arguments import RunOnCaptureArguments, SpectraArguments
from thermosplat.errors import UserError


@dataclass(frozen=True)
class RenderArguments(SpectraArguments, RunOnCaptureArguments):
    """Render a trained run along a camera path: a video or PNGs of one spectrum, or of several side by side."""

    path: Literal["interp", "ellipse", "spiral", "train", "test"] = "interp"
    """Smoothly through the training views; an ellipse around the scene; a spiral in front of it; or the views of the
    training or the held-out split themselves."""
    format: Literal["mp4", "png"] = "mp4"
    """A video (H.264 with the extra "video" installed: pip install ".[video]"), or a folder of PNGs, named
    by the frames on the train and test paths and numbered on the others."""
    frames: int = 120
    """Images along the path; the train and test paths have one for each view."""
    fps: int = 30
    """Images a second of the video."""


def main(argv: list[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: Arguments without the program's name. None: the process's.

    Returns:
        The exit code.
    """
    return run_program(RenderArguments, _render, argv, prog="thermosplat-render")


def _render(arguments: RenderArguments) -> int:
    for name in ("frames", "fps"):
        if getattr(arguments, name) < 1:
            raise UserError(f"--{name} must be at least 1, found {getattr(arguments, name)}.")

    with importing():
        from rich.progress import track

        from thermosplat.evaluation.held_out import file_stem
        from thermosplat.evaluation.loaded_run import load_run
        from thermosplat.novel_views.viewpoints import rendered_images, viewpoints
        from thermosplat.pictures.video import write_images
        from thermosplat.runs.atomic_writes import check_is_no_link

    loaded = load_run(arguments.run, step=arguments.step, device=arguments.device)
    shown = arguments.chosen(list(loaded.model.spectra))
    capture = loaded.capture(arguments.data)
    for note in (*loaded.notes, *capture.notes):
        print(note)
    points = viewpoints(capture, arguments.path, shown, num_frames=arguments.frames, device=loaded.device)
    name = f"{arguments.path}_{'-'.join(shown)}_{loaded.result_name(capture)}"
    videos = loaded.directory.videos
    check_is_no_link(videos / name)
    images = rendered_images(loaded.model, points, sh_degree=loaded.sh_degree, scales=loaded.scales)
    written = write_images(
        track(images, f"Rendering {arguments.path}", len(points), transient=True, disable=not sys.stdout.isatty()),
        videos / name,
        format=arguments.format,
        fps=arguments.fps,
        names=[file_stem(point.frame) for point in points] if arguments.path in ("train", "test") else None,
    )
    if arguments.format == "mp4" and written.is_dir():
        print("No video encoder here, so PNGs were written.")
    print(f"{len(points)} images: {written}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
