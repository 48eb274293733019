"""thermosplat-view: a trained scene in the browser, from anywhere, with its temperatures."""

import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated

import tyro

from thermosplat.cli.host_settings import importing, prepare_host
from thermosplat.cli.program import run_program
from thermosplat.cli.recalculating import known_scale
from thermosplat.cli.viewer_flags import checked_port
from thermosplat.config.temperature_settings import TemperatureSettings


@dataclass(frozen=True, kw_only=True)
class ViewArguments(TemperatureSettings):
    """Look at a trained scene in the browser: every spectrum, depth, errors, and temperatures under the cursor.

    Examples:
      thermosplat-view results/shed/thermosplat_plus
      thermosplat-view results/shed/thermosplat_plus/ckpts/step_006000.pt
      thermosplat-view splat.ply
      thermosplat-view results/june --compare comparison
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|CHECKPOINT|PLY")]
    """Result folder of thermosplat-train, one of its checkpoints, or a PLY file of 3D Gaussians."""
    step: int | None = None
    """Checkpoint of the run to take. None: the last one."""
    data: str | None = None
    """Folder of the capture, if it has moved since the training."""
    device: str = "auto"
    """"cuda", "cuda:1", "cpu", or "auto": CUDA where there is a device."""
    compare: str | None = None
    """Folder of thermosplat-compare: the earlier date, and what changed since then, are layers beside the run's."""
    query: str | None = None
    """File (.npy) with a vector that features are compared with: a layer of the viewer shows where they are alike."""
    out: str | None = None
    """Folder for measurements, pictures, videos and bookmarks. None: RUN/measurements."""
    host: str = "127.0.0.1"
    """Address to serve at. Others than this machine's own can be reached from elsewhere: the page's address then has a
    random token in it."""
    port: int = 8080
    """Port to serve at, or the next one that is free."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


def main(argv: list[str] | None = None) -> int:
    """Run the command with some words, or with the process's; the exit code: 130 after Ctrl-C, which ends it."""
    unfinished: list[str] = []
    code = run_program(ViewArguments, lambda arguments: _view(arguments, unfinished), argv, prog="thermosplat-view")
    if unfinished:  # Python would end under a thread that renders, and abort there
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


def _view(arguments: ViewArguments, unfinished: list[str]) -> int:
    checked_port("--port", arguments.port)
    prepare_host()
    with ThreadPoolExecutor(max_workers=1) as thread:  # viser is imported while the scene is read
        with importing():
            from thermosplat.viewer.front_end import Viewer
            from thermosplat.viewer.opening import open_scene

        thread.submit(import_module, "viser")  # where it is missing, the server says so
        scene, folder, notes = open_scene(
            arguments.scene,
            step=arguments.step,
            data=arguments.data,
            device=arguments.device,
            settings=arguments.checked(),
            scale_of=known_scale,
            query=arguments.query,
            compare=arguments.compare,
        )
    for note in notes:
        print(note)
    folder = folder if arguments.out is None else Path(arguments.out).expanduser()
    viewer = Viewer(scene, folder, host=arguments.host, port=arguments.port)
    print(f"{scene.name}: {viewer.url}", flush=True)
    print("Ctrl-C ends the viewer.", flush=True)
    try:
        threading.Event().wait()
    finally:
        if not viewer.stop():
            unfinished.append("a picture")
    return 0


if __name__ == "__main__":
    sys.exit(main())
