"""How true are the depths of a run?

    python benchmarks/bench_depths.py RUN... [--data FOLDER] [--device auto] [--json depths.json]

Compares what a run renders in the held-out views with their true depths: the median depth, which everything here shows
and exports, and the expected depth Σ w z / Σ w, which other renderers show. Milliseconds are of a picture of the first
held-out view, both depths by turns (measuring/timing.py). bench_depth_evidence.py tells what the images say of depths.
"""

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from measuring.markdown_table import markdown_table
from measuring.timing import time_interleaved
from scenes.held_out_depths import held_out
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import view_tensors
from thermosplat.evaluation.loaded_run import LoadedRun, load_run
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.environment import environment

KINDS = {"median": False, "expected": True}
"""Depths by name, and what ``render_depth`` is told for them."""
REPEATS = 20


@torch.no_grad()
def depth_errors(loaded: LoadedRun, capture: Capture) -> list[dict[str, Any]]:
    """A row for each spectrum and kind of depth: relative errors, and the share on the spectrum's own surface."""
    rows = []
    for name in loaded.model.spectra:
        views = [(one, view_tensors(one.view, None, loaded.device)) for one in held_out(capture, name)]
        renders = {
            kind: partial(loaded.model.render_depth, name, expected=expected) for kind, expected in KINDS.items()
        }
        first = {kind: partial(render, views[0][1]) for kind, render in renders.items()}
        took = time_interleaved(first, loaded.device, REPEATS)
        for kind, render in renders.items():
            found = [(one, render(camera).double().cpu().numpy()) for one, camera in views]
            error = np.concatenate([one.relative_errors(depth) for one, depth in found])
            own = np.concatenate([one.on_own_surface(depth)[one.differs] for one, depth in found])
            numbers = {"median": np.median(error), "mean": error.mean(), "p90": np.percentile(error, 90)}
            numbers["ms"] = took[kind]["median_ms"]
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
