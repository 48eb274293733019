"""How many held-out pixels lie in their 95% intervals, and what is shaded as not to be read?

    python benchmarks/bench_certainty.py RUN... [--data FOLDER] [--json out.json]

Held-out views are judged in two halves: intervals of one half are as wide as the other half says, so that no pixel
widens its own interval. Shares of pixels that are shaded are by label, where the capture has labels: what reflects
(glass, chrome, gloss) is to be shaded, and the rest is not.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from thermosplat.datasets.ground_truth import LABELS, read_ground_truth
from thermosplat.evaluation.loaded_run import load_run
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.environment import environment
from thermosplat.thermography.certainty import DOUBTS, Certainty

_REFLECTING = ("glass", "specular")
"""Labels of what is to be shaded."""
_TOLD = 0.005
"""Least share of the pixels whose reason is printed."""


@torch.no_grad()
def judged(named: str, data: str | None) -> list[dict[str, Any]]:
    """A row for each label of a run, and one for all pixels."""
    loaded = load_run(named)
    capture = loaded.capture(data)
    spectrum = next(name for name, scale in loaded.scales.items() if scale.measured_unit is not None)
    how: dict[str, Any] = {"sh_degree": loaded.sh_degree, "device": loaded.device}
    certainty = Certainty(loaded.model, capture, spectrum, loaded.scales[spectrum], **how)
    halves = capture.test[::2], capture.test[1::2]
    parts: dict[str, list[Any]] = {"inside": [], "half": [], "doubts": [], "label": []}
    for mine, others in (halves, halves[::-1]):
        calibration = certainty.calibrated(list(others))
        for frame in mine:
            error, half, doubts = certainty.compared(frame, calibration)
            truth = read_ground_truth(capture, frame)
            there = np.isfinite(half) & np.isfinite(error)
            parts["inside"].append(np.abs(error)[there] <= half[there])
            parts["half"].append(half[there])
            parts["doubts"].append(doubts[there])
            parts["label"].append(np.zeros(there.sum(), int) if truth is None else truth.label[there])
    inside, half, doubts, label = (np.concatenate(parts[name]) for name in parts)
    rows = []
    reflects = np.isin(label, [key for key, name in LABELS.items() if name in _REFLECTING])
    groups = {"all": label >= 0, "what reflects": reflects, "the rest": ~reflects}
    for name, chosen in {**groups, **{name: label == key for key, name in LABELS.items()}}.items():
        if chosen.any():
            reasons = {text: float(((doubts[chosen] & bit) > 0).mean()) for bit, text in DOUBTS.items()}
            found = {"run": loaded.directory.path.name, "label": name, "pixels": int(chosen.sum())}
            shares = {"inside": float(inside[chosen].mean()), "shaded": float((doubts[chosen] > 0).mean())}
            rows.append({**found, **shares, "half": float(np.median(half[chosen])), "reasons": reasons})
    return rows


def main() -> None:
    """Judge and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="result folders")
    parser.add_argument("--data", help="where the capture lies now")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    print("| run | pixels of | number | in their interval | median half [°C] | shaded | because |")
    print("|---|---|---|---|---|---|---|")
    for run in arguments.runs:
        for row in judged(run, arguments.data):
            why = sorted(row["reasons"].items(), key=lambda reason: -reason[1])
            said = ", ".join(f"{text} {share:.1%}" for text, share in why if share >= _TOLD)
            print(
                f"| {row['run']} | {row['label']} | {row['pixels']:,} | {row['inside']:.1%} | {row['half']:.2f} | "
                f"{row['shaded']:.1%} | {said} |",
                flush=True,
            )
            rows.append(row)
    if arguments.json is not None:
        write_text(arguments.json, json.dumps({"environment": environment(torch.device("cpu")), "rows": rows}) + "\n")


if __name__ == "__main__":
    main()
