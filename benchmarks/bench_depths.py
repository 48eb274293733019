"""How true are the depths of a run?

    python benchmarks/bench_depths.py RUN... [--data FOLDER] [--device auto] [--json depths.json]

Compares what a run renders in the held-out views with their true depths: the median depth, which everything here shows
and exports, and the expected depth Σ w z / Σ w, which other renderers show. Milliseconds are of one picture, the median
over the views, each rendered for the second time. bench_depth_evidence.py tells what the images say of depths.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from measuring.markdown_table import markdown_table
from scenes.held_out_depths import held_out
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import view_tensors
from thermosplat.evaluation.loaded_run import LoadedRun, load_run
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.environment import environment


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
                errors.append(one.relative_errors(found))
                right.append(one.on_own_surface(found)[one.differs])
            error, own = np.concatenate(errors), np.concatenate(right)
            numbers = {"median": np.median(error), "mean": error.mean(), "p90": np.percentile(error, 90)}
            numbers["ms"] = np.median(took)
            share = {"own": float(own.mean())} if len(own) else {}
            words = {"run": loaded.directory.path.name, "capture": capture.name, "spectrum": name, "depth": kind}
            rows.append(words | {key: float(value) for key, value in numbers.items()} | share)
    return rows


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="result folders of captures with ground truth")
    parser.add_argument("--data", help="where the capture lies now")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    for run in arguments.runs:
        loaded = load_run(run, device=arguments.device)
        rows += depth_errors(loaded, loaded.capture(arguments.data))
    words, share = dict.fromkeys(("run", "capture", "spectrum", "depth"), "{}"), "{:.2%}"
    numbers = {"median": share, "mean": share, "p90": share, "own": "{:.1%}", "ms": "{:.1f}"}
    print(markdown_table(rows, words | numbers))
    if arguments.json is not None:
        report = {"environment": environment(loaded.device), "depths": rows}
        write_text(arguments.json, json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
