"""Does the 3D smoothing filter show views better from four times nearer, and from four times farther away?

    thermosplat-train data/desk --data-factor 4 --model.filter-3d --result-dir results/zoom/desk_filter
    python benchmarks/bench_zoom.py RUN... [--data FOLDER] [--device auto] [--json zoom.json]

Renders the held-out views of runs with images of trained size, of a quarter of its sides, and of four times its sides,
by cameras whose focal lengths grow with the images. PSNR [dB] is of held-out images: as they are, averaged over the
area of each new pixel (OpenCV's INTER_AREA), and as the capture has them before ``--data-factor``, which must be a
multiple of 4 for that. Each is the mean over views.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from measuring.markdown_table import markdown_table
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import ViewTensors, readout_tensor, unit_image, view_tensors
from thermosplat.datasets.lens import shrunk
from thermosplat.evaluation.loaded_run import LoadedRun, load_run
from thermosplat.image_quality.metrics import psnr
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.devices import choose_device
from thermosplat.runs.environment import environment
from thermosplat.training.frames.shrunk_frames import area_averages

ZOOM = 4
LARGEST = 10**6
"""Longest side of images that nothing shrinks [px]."""
WHOLE = 1.0 - 1e-4
"""Share of a new pixel's area from which on all that it covers counts, but for rounding."""


def views_of(frame: Frame, spectra: list[str], shrink: int, device: torch.device) -> dict[str, ViewTensors]:
    """A frame's views with images whose sides are divided by a whole number."""
    found = {}
    for name, taken in frame.views.items():
        if name not in spectra:
            continue
        view = view_tensors(taken, None, device)
        if shrink > 1:
            camera = shrunk(taken.camera, float(shrink))
            size = camera.width, camera.height
            mask = None if view.mask is None else area_averages(view.mask.float(), *size) > WHOLE
            readout = None if taken.readout is None else taken.readout.resized(taken.camera, camera)
            view = replace(
                view,
                K=torch.tensor(camera.K, dtype=torch.float32, device=device),
                width=camera.width,
                height=camera.height,
                image=area_averages(unit_image(view.image), *size),
                mask=mask,
                values=None,
                readout=readout_tensor(readout, device),
            )
        found[name] = view
    return found


@torch.no_grad()
def decibels(loaded: LoadedRun, capture: Capture, shrink: int = 1) -> dict[str, float]:
    """Mean PSNR of the held-out views [dB], by spectrum."""
    found: dict[str, list[float]] = {}
    for frame in capture.test:
        views = views_of(frame, list(loaded.model.spectra), shrink, loaded.device)
        groups = [[name for name in group if name in views] for group in frame.shared_cameras]
        rendered = loaded.model.render(views, sh_degree=loaded.sh_degree, shared_cameras=groups)
        for name, image in rendered.images.items():
            found.setdefault(name, []).append(psnr(image.clamp(0, 1), views[name].image, views[name].mask))
    return {name: sum(values) / len(values) for name, values in found.items()}


def larger(loaded: LoadedRun, capture: Capture, data: str | None) -> Capture | None:
    """The capture with images of four times the size; None: it has none.

    Raises:
        ValueError: Pixel values mean something else there.
    """
    factor, rest = divmod(loaded.config.data_factor, ZOOM)
    if rest:
        return None
    config = replace(loaded.config, data_factor=factor, image_size=LARGEST)
    found = replace(loaded, config=config).capture(data)
    for name, scale in capture.scales.items():
        if found.scales[name].range != scale.range:
            raise ValueError(f"{name} images have the range {found.scales[name].range} there, not {scale.range}.")
    return found


def rows_of(run: str, data: str | None, device: str) -> Iterator[dict[str, Any]]:
    """A row for each spectrum of a run."""
    loaded = load_run(run, device=device)
    capture = loaded.capture(data)
    found = {"quarter": decibels(loaded, capture, ZOOM), "trained": decibels(loaded, capture)}
    if (large := larger(loaded, capture, data)) is not None:
        found["four times"] = decibels(loaded, large)
    for name in loaded.model.spectra:
        camera = next(frame.views[name].camera for frame in capture.test if name in frame.views)
        yield {
            "run": loaded.directory.path.name,
            "capture": capture.name,
            "filter": "yes" if loaded.config.model.filter_3d else "no",
            "gaussians": loaded.model.num_gaussians,
            "spectrum": name,
            "size": f"{camera.width}x{camera.height}",
            **{scale: of_scale[name] for scale, of_scale in found.items() if name in of_scale},
        }


def main() -> None:
    """Render, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="result folders")
    parser.add_argument("--data", help="where the capture lies now")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = [row for run in arguments.runs for row in rows_of(run, arguments.data, arguments.device)]
    columns = dict.fromkeys(("run", "capture", "filter", "spectrum", "size"), "{}") | {"gaussians": "{:,}"}
    print(markdown_table(rows, columns | dict.fromkeys(("quarter", "trained", "four times"), "{:.2f}")))
    if arguments.json is not None:
        report = {"environment": environment(choose_device(arguments.device)), "zoom": rows}
        write_text(arguments.json, json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
