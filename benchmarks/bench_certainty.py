"""How many held-out pixels lie in their 95% intervals, and what is shaded as not to be read?

    python benchmarks/bench_certainty.py RUN... [--data FOLDER] [--scene rig_desk] [--data-factor 4]
        [--json out.json]

Held-out views are judged in two halves: intervals of one half are as wide as the other half says, so that no pixel
widens its own interval. Shares of pixels that are shaded are by label, where the capture has labels: what reflects
(glass, chrome, gloss) is to be shaded, and the rest is not. ``--scene`` has labels for captures without them: those of
the scene that they were rendered from, and says which pixels two training images truly show.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import view_tensors
from thermosplat.datasets.ground_truth import LABELS, read_ground_truth
from thermosplat.evaluation.loaded_run import load_run
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.environment import environment
from thermosplat.thermography.certainty import DOUBTS, Certainty

Array = NDArray[Any]
_REFLECTING = ("glass", "specular")
"""Labels of what is to be shaded."""
_TWO = 2
"""Training images without which nobody knows how far away a point is."""
_TOLD = 0.005
"""Least share of the pixels whose reason is printed."""


class Pixels(NamedTuple):
    """Pixels of held-out views, each [P]."""

    error: Array
    """[°C]."""
    half: Array
    """Half of the interval [°C]."""
    doubts: Array
    """Bits of ``DOUBTS``."""
    label: Array
    """Keys of ``LABELS``."""
    seen: Array
    """How many training images show it; -1: nobody knows."""


@torch.no_grad()
def judged(named: str, data: str | None, scene: str | None = None, factor: int | None = None) -> list[dict[str, Any]]:
    """A row for each label of a run, and some for all pixels.

    Args:
        named: A result folder.
        data: Where its capture lies now; None: where it lay.
        scene: What the capture was rendered from, for one without labels.
        factor: By how much images are made smaller; None: as in training.
    """
    loaded = load_run(named)
    if factor is not None:
        loaded = replace(loaded, config=replace(loaded.config, data_factor=factor))
    capture = loaded.capture(data)
    spectrum = next(name for name, scale in loaded.scales.items() if scale.measured_unit is not None)
    how: dict[str, Any] = {"sh_degree": loaded.sh_degree, "device": loaded.device}
    certainty = Certainty(loaded.model, capture, spectrum, loaded.scales[spectrum], **how)
    known = _known(capture, spectrum, scene)
    halves = capture.test[::2], capture.test[1::2]
    parts: list[Pixels] = []
    for mine, others in (halves, halves[::-1]):
        calibration = certainty.calibrated(list(others))
        for frame in mine:
            error, half, doubts = certainty.compared(frame, calibration)
            label, seen = known(frame)
            there = np.isfinite(half) & np.isfinite(error)
            parts.append(Pixels(*(picture[there] for picture in (error, half, doubts, label, seen))))
    return rows_of(loaded.directory.path.name, Pixels(*map(np.concatenate, zip(*parts, strict=True))))


def rows_of(run: str, pixels: Pixels) -> list[dict[str, Any]]:
    """A row for each group of pixels that there are."""
    reflects = np.isin(pixels.label, [key for key, name in LABELS.items() if name in _REFLECTING])
    shaded = pixels.doubts > 0
    groups = {"all": pixels.label >= 0, "what reflects": reflects, "the rest": ~reflects}
    if (pixels.seen >= 0).any():
        groups["the rest that two training images show"] = ~reflects & (pixels.seen >= _TWO)
    groups |= {"what is shaded": shaded, "what is not": ~shaded}
    rows = []
    for name, chosen in {**groups, **{name: pixels.label == key for key, name in LABELS.items()}}.items():
        if chosen.any():
            error, half, doubts = np.abs(pixels.error[chosen]), pixels.half[chosen], pixels.doubts[chosen]
            reasons = {text: float(((doubts & bit) > 0).mean()) for bit, text in DOUBTS.items()}
            found = {"run": run, "label": name, "pixels": int(chosen.sum()), "mean_error": float(error.mean())}
            shares = {"inside": float((error <= half).mean()), "shaded": float((doubts > 0).mean())}
            rows.append({**found, **shares, "half": float(np.median(half)), "reasons": reasons})
    return rows


def _known(capture: Capture, spectrum: str, scene: str | None) -> Callable[[Frame], tuple[Array, Array]]:
    """Of a frame: labels, and how many training images show a pixel's point (-1: nobody knows), each [H, W]."""
    if scene is None:

        def of_files(frame: Frame) -> tuple[Array, Array]:
            camera, truth = frame.views[spectrum].camera, read_ground_truth(capture, frame)
            label = np.zeros((camera.height, camera.width), int) if truth is None else truth.label
            return label, np.full(label.shape, -1)

        return of_files
    from rendered_captures.rendering.start import start

    start("llvm_ad_rgb")
    from rendered_captures.true_surfaces import TrueSurfaces

    true = TrueSurfaces(scene, capture, spectrum)

    def of_scene(frame: Frame) -> tuple[Array, Array]:
        view = view_tensors(frame.views[spectrum], None, "cpu")
        return true.labels(view), true.seen(view)

    return of_scene


def main() -> None:
    """Judge and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="result folders")
    parser.add_argument("--data", help="where the capture lies now")
    scenes = ("rig_desk", "flight_a", "flight_b", "flight_c")
    parser.add_argument("--scene", choices=scenes, help="what the capture was rendered from")
    parser.add_argument("--data-factor", type=int, help="judge images that are so many times smaller")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    print("| run | pixels of | number | in their interval | median half [°C] | mean error [°C] | shaded | because |")
    print("|---|---|---|---|---|---|---|---|")
    for run in arguments.runs:
        for row in judged(run, arguments.data, arguments.scene, arguments.data_factor):
            why = sorted(row["reasons"].items(), key=lambda reason: -reason[1])
            said = ", ".join(f"{text} {share:.1%}" for text, share in why if share >= _TOLD)
            print(
                f"| {row['run']} | {row['label']} | {row['pixels']:,} | {row['inside']:.1%} | {row['half']:.2f} | "
                f"{row['mean_error']:.3f} | {row['shaded']:.1%} | {said} |",
                flush=True,
            )
            rows.append(row)
    if arguments.json is not None:
        write_text(arguments.json, json.dumps({"environment": environment(torch.device("cpu")), "rows": rows}) + "\n")


if __name__ == "__main__":
    main()
