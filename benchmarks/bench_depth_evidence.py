"""What do the images of a capture say of depth, where no scene is trained?

    python benchmarks/bench_depth_evidence.py CAPTURE... [--data-factor 1] [--windows 9 17 31] [--json evidence.json]

The first table asks at which depth the images agree, where the spectra see different surfaces, such as glass: each
pixel of a held-out image is carried into all training images by a depth, and the median of what they show there is
compared with it. The depths are the true one, that of the other spectrum's surface, and true ones times some factors. A
spectrum that agrees no better at its own depth than at another one cannot be taught which it is.

The second table is of a plane sweep (scenes/swept_depths.py): the depth at which the nearest training images agree best
over a window around each pixel. The third one is of the depths that training draws scenes to
(``SpectrumConfig.swept_depth``), where they are known: sweeps that compare each view's own image too, and what views
agree on; here the held-out views take part as well. Errors are relative, over all pixels; shares are of the pixels that
lie nearer to the spectrum's own surface than to the other's. bench_depths.py has the same numbers of trained scenes.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from measuring.markdown_table import markdown_table
from scenes.held_out_depths import HeldOut, held_out
from scenes.surface_points import surface_points
from scenes.swept_depths import carried, in_unit_range, swept_depths
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture, View
from thermosplat.datasets.frame_tensors import view_tensors
from thermosplat.datasets.ground_truth import LABELS
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.environment import environment
from thermosplat.training.swept_depths.plane_sweep import SPAN
from thermosplat.training.swept_depths.swept_depths import depths_of_views

Array = NDArray[np.float64]
FACTORS = (0.95, 0.98, 0.99, 1.01, 1.02, 1.05)
"""Wrong depths, as shares of the true ones."""


def agreement(
    one: HeldOut, depth: Array, chosen: NDArray[np.bool_], training: Sequence[tuple[View, NDArray[np.float32]]]
) -> Array:
    """Squared errors of the median of what the training images show at a depth, one for each chosen pixel."""
    places = surface_points(one.view, depth)[chosen]
    shown = np.stack([carried(places, *view) for view in training])
    target = in_unit_range(one.view)[chosen]
    known = ~np.isnan(shown[..., 0]).all(0)
    return ((np.nanmedian(shown[:, known], axis=0) - target[known]) ** 2).mean(-1)


def agreements(capture: Capture) -> list[dict[str, Any]]:
    """A row for each spectrum and kind of surface: agreement [dB] at the true depth and at others."""
    rows = []
    for name in capture.spectra:
        views = list(held_out(capture, name))
        training = [(view, in_unit_range(view)) for view in training_views(capture, name)]
        for label, kind in LABELS.items():
            chosen = [one.differing(label) for one in views]
            if not any(mask.any() for mask in chosen):
                continue
            at = {"own": [one.own for one in views], "other": [one.other for one in views]}
            at |= {f"{factor:g}": [factor * one.own for one in views] for factor in FACTORS}
            row: dict[str, Any] = {"capture": capture.name, "spectrum": name, "surface": kind}
            row["pixels"] = int(sum(mask.sum() for mask in chosen))
            for key, depths in at.items():
                errors = [agreement(*each, training) for each in zip(views, depths, chosen, strict=True)]
                row[key] = float(-10 * np.log10(np.concatenate(errors).mean()))
            rows.append(row)
    return rows


def training_views(capture: Capture, name: str) -> list[View]:
    """The training views of a spectrum."""
    return [frame.views[name] for frame in capture.train if name in frame.views]


def sweeps(capture: Capture, windows: Sequence[int]) -> list[dict[str, Any]]:
    """A row for each spectrum and window: errors of a plane sweep, and shares on the spectrum's own surface."""
    rows = []
    for name in capture.spectra:
        views, training = list(held_out(capture, name)), training_views(capture, name)
        if not views:
            continue
        swept = [swept_depths(one.view, training, *swept_span(one.view, capture.points), windows) for one in views]
        for window in windows:
            found = [(one, depths[window]) for one, depths in zip(views, swept, strict=True)]
            error = np.concatenate([one.relative_errors(depth) for one, depth in found])
            row: dict[str, Any] = {"capture": capture.name, "spectrum": name, "window": window}
            row |= {"median": float(np.median(error)), "mean": float(error.mean())}
            for label, kind in LABELS.items():
                right = [one.on_own_surface(depth)[one.differing(label)] for one, depth in found]
                if any(map(len, right)):
                    row[kind] = float(np.concatenate(right).mean())
            rows.append(row)
    return rows


@torch.no_grad()
def agreed(capture: Capture) -> list[dict[str, Any]]:
    """A row for each spectrum: share of the held-out pixels with a depth that views agree on, and its errors."""
    rows = []
    for name in capture.spectra:
        views = list(held_out(capture, name))
        if not views:
            continue
        all_views = [*training_views(capture, name), *(one.view for one in views)]
        tensors = [view_tensors(view, capture.scales[name], "cpu") for view in all_views]
        depths = depths_of_views(tensors, torch.from_numpy(capture.points))
        found = [(one, depth.double().numpy()) for one, depth in zip(views, depths[-len(views) :], strict=True)]
        known = np.concatenate([depth[one.own > 0] > 0 for one, depth in found])
        error = np.concatenate([one.relative_errors(depth) for one, depth in found])[known]
        row: dict[str, Any] = {"capture": capture.name, "spectrum": name, "known": float(known.mean())}
        row |= {"median": float(np.median(error)), "mean": float(error.mean())}
        for label, kind in LABELS.items():
            right = [one.on_own_surface(depth)[one.differing(label) & (depth > 0)] for one, depth in found]
            if any(map(len, right)):
                row[kind] = float(np.concatenate(right).mean())
        rows.append(row)
    return rows


def swept_span(view: View, points: Array) -> tuple[float, float]:
    """Smallest and largest depth that a sweep tries [world units] (``SPAN``)."""
    depths = points @ view.viewmat[2, :3] + view.viewmat[2, 3]
    nearest, farthest = np.percentile(depths[depths > 0], (1, 99))
    return SPAN[0] * float(nearest), SPAN[1] * float(farthest)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", help="folders of captures with ground truth")
    parser.add_argument("--data-factor", type=int, default=1, help="divide the images' width and height by this")
    parser.add_argument("--windows", type=int, nargs="+", default=[9, 17, 31], help="sides of the sweep's windows [px]")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    captures = [load_capture(folder, data_factor=arguments.data_factor) for folder in arguments.captures]
    seen = [row for capture in captures for row in agreements(capture)]
    words = dict.fromkeys(("capture", "spectrum", "surface"), "{}") | {"pixels": "{:,}"}
    print(
        markdown_table(seen, words | dict.fromkeys(("own", "other", *map("{:g}".format, FACTORS)), "{:.2f}")),
        flush=True,
    )
    swept = [row for capture in captures for row in sweeps(capture, arguments.windows)]
    words = dict.fromkeys(("capture", "spectrum", "window"), "{}") | dict.fromkeys(("median", "mean"), "{:.2%}")
    kinds = [kind for kind in LABELS.values() if any(kind in row for row in swept)]
    print("\n" + markdown_table(swept, words | dict.fromkeys(kinds, "{:.1%}")), flush=True)
    shared = [row for capture in captures for row in agreed(capture)]
    words = dict.fromkeys(("capture", "spectrum"), "{}") | {"known": "{:.1%}"}
    words |= dict.fromkeys(("median", "mean"), "{:.2%}")
    print("\n" + markdown_table(shared, words | dict.fromkeys(kinds, "{:.1%}")))
    if arguments.json is not None:
        report = {"environment": environment(torch.device("cpu")), "agreement": seen, "sweeps": swept, "agreed": shared}
        write_text(arguments.json, json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
