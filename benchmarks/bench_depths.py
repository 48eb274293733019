"""How true are the depths of a run, and what do the images say of them?

    python benchmarks/bench_depths.py RUN... [--data FOLDER] [--device auto] [--json depths.json]

The first table compares what a run renders in the held-out views with their true depths: the median depth, which
everything here shows and exports, and the expected depth Σ w z / Σ w, which other renderers show.

The second table needs no run's model. Where the spectra see different surfaces, such as glass, it asks at which depth
the images agree: each pixel of a held-out image is carried into all training images by a depth, and the median of what
they show there is compared with it. The depths are the true one, that of the other spectrum's surface, and true ones
times some factors. A spectrum that agrees no better at its own depth than at another one cannot be taught which it is.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scenes.surface_points import surface_points
from thermosplat.datasets.capture import Capture, View
from thermosplat.datasets.frame_tensors import view_tensors
from thermosplat.datasets.ground_truth import LABELS, GroundTruth, read_ground_truth
from thermosplat.evaluation.labelled_regions import DIFFERING
from thermosplat.evaluation.loaded_run import LoadedRun, load_run
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.environment import environment

Array = NDArray[np.float64]
FACTORS = (0.95, 0.98, 0.99, 1.01, 1.02, 1.05)
"""Wrong depths, as shares of the true ones."""


class HeldOut(NamedTuple):
    """A held-out view with its true depths."""

    view: View
    truth: GroundTruth
    own: Array
    """True depth [world units], [H, W]; 0 where there is none."""
    other: Array
    """That of the other spectrum's surface."""

    @property
    def differs(self) -> NDArray[np.bool_]:
        """Where the two surfaces differ."""
        return (self.own > 0) & (self.other > 0) & (np.abs(self.own - self.other) > DIFFERING * self.own)


def held_out(capture: Capture, name: str) -> Iterator[HeldOut]:
    """The held-out views of a spectrum that have true depths."""
    for frame in capture.test:
        truth = read_ground_truth(capture, frame)
        if truth is not None and name in frame.views:
            own, *others = (truth.depths[one].astype(np.float64) for one in sorted(truth.depths, key=name.__ne__))
            yield HeldOut(frame.views[name], truth, own, others[0] if others else own)


def milliseconds(work: Callable[[], object], device: torch.device) -> float:
    """Time of some work on a device, whose earlier work is done."""
    begin = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return 1000 * (time.perf_counter() - begin)


@torch.no_grad()
def depth_errors(loaded: LoadedRun, capture: Capture) -> list[dict[str, Any]]:
    """A row for each spectrum and kind of depth: relative errors, and the share on the spectrum's own surface."""
    rows = []
    for name in loaded.model.spectra:
        views = list(held_out(capture, name))
        for kind in ("median", "expected"):
            errors, right, took = [], [], []
            for one in views:
                camera = view_tensors(one.view, None, loaded.device)
                render = partial(loaded.model.render_depth, name, camera, expected=kind == "expected")
                found = render().double().cpu().numpy()
                took.append(milliseconds(render, loaded.device))
                errors.append((np.abs(found - one.own) / one.own.clip(1e-9))[one.own > 0])
                nearer = (np.abs(found - one.own) < np.abs(found - one.other)) & (found > 0)
                right.append(nearer[one.differs])
            error, own = np.concatenate(errors), np.concatenate(right)
            numbers = {"median": np.median(error), "mean": error.mean(), "p90": np.percentile(error, 90)}
            numbers["ms"] = np.median(took)
            share = {"own": float(own.mean())} if len(own) else {}
            words = {"run": loaded.directory.path.name, "capture": capture.name, "spectrum": name, "depth": kind}
            rows.append(words | {key: float(value) for key, value in numbers.items()} | share)
    return rows


def in_unit_range(view: View) -> NDArray[np.float32]:
    """An image in [0, 1], [H, W, C]."""
    pixels = view.pixels().image
    return pixels.astype(np.float32) / (255 if pixels.dtype == np.uint8 else 1)


def carried(places: Array, view: View) -> Array:
    """What a view shows at places of the scene [P, 3], as [P, C] in [0, 1]; NaN outside the image."""
    camera, image = view.camera, in_unit_range(view)
    seen = places @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    at = (seen @ camera.K.T)[:, :2] / seen[:, 2:].clip(1e-9) - 0.5  # cv2 counts from the centre of the first pixel
    inside = (seen[:, 2] > 0) & (at >= 0).all(1) & (at <= (camera.width - 1, camera.height - 1)).all(1)
    shown = cv2.remap(image, at.astype(np.float32)[None], None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)[0]
    return np.where(inside[:, None], shown.reshape(len(places), -1), np.nan)


def agreement(one: HeldOut, depth: Array, chosen: NDArray[np.bool_], training: Sequence[View]) -> Array:
    """Squared errors of the median of what the training images show at a depth, one for each chosen pixel."""
    places = surface_points(one.view, depth)[chosen]
    shown = np.stack([carried(places, view) for view in training])
    target = in_unit_range(one.view)[chosen]
    known = ~np.isnan(shown[..., 0]).all(0)
    return ((np.nanmedian(shown[:, known], axis=0) - target[known]) ** 2).mean(-1)


def evidence(capture: Capture) -> list[dict[str, Any]]:
    """A row for each spectrum and kind of surface: agreement [dB] at the true depth and at others."""
    rows = []
    for name in capture.spectra:
        views, training = list(held_out(capture, name)), [f.views[name] for f in capture.train if name in f.views]
        for label, kind in LABELS.items():
            chosen = [one.differs & (one.truth.label == label) for one in views]
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


def table(rows: Sequence[dict[str, Any]], forms: dict[str, str]) -> str:
    """Rows as Markdown; ``forms``: the columns, and how their numbers are written."""
    lines = ["| " + " | ".join(forms) + " |", "|---" * len(forms) + "|"]
    for row in rows:
        cells = [form.format(row[key]) if key in row else "" for key, form in forms.items()]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="result folders of captures with ground truth")
    parser.add_argument("--data", help="where the capture lies now")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows, captures = [], {}
    for run in arguments.runs:
        loaded = load_run(run, device=arguments.device)
        capture = loaded.capture(arguments.data)
        captures[capture.root, next(iter(capture.train[0].views.values())).camera.width] = capture
        rows += depth_errors(loaded, capture)
    words, share = dict.fromkeys(("run", "capture", "spectrum", "depth"), "{}"), "{:.2%}"
    print(table(rows, words | {"median": share, "mean": share, "p90": share, "own": "{:.1%}", "ms": "{:.1f}"}), flush=True)
    seen = [row for capture in captures.values() for row in evidence(capture)]
    words = dict.fromkeys(("capture", "spectrum", "surface"), "{}") | {"pixels": "{:,}"}
    print("\n" + table(seen, words | dict.fromkeys(("own", "other", *map("{:g}".format, FACTORS)), "{:.2f}")))
    if arguments.json is not None:
        report = {"environment": environment(torch.device("cpu")), "depths": rows, "evidence": seen}
        write_text(arguments.json, json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
