"""How exactly does ``--refine`` find disturbed cameras, and what does the scene lose?

    python benchmarks/bench_refinement.py data/rig_desk --points data/rgbt_synthetic/desk/sparse/0          full size
    python benchmarks/bench_refinement.py data/rig_desk --points ... --small                              two CPU cores
    python benchmarks/bench_refinement.py data/rig_desk --points ... --wrong rig poses                    the poses, too

Writes the capture with the true cameras and with disturbed ones: the thermal camera by 1°, 2 cm and 5% of the focal
length, or every exposure by 0.3° and 0.5% of the cameras' extent. Trains the true one as it is, the disturbed one as it
is and with ``--refine``. Prints how far points land from where the true thermal camera sees them [px of the
untouched image], how far the photographs' poses are off after a similarity, and held-out PSNR. Writes refinement.json.
``--small`` means photographs of 200x150 and thermal images of 160x120 pixels, 4,000 Gaussians and the preset demo.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast, get_args

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)
import numpy as np
import torch
from numpy.typing import NDArray

from preparation.rig_capture import Disturbance, thermal_errors, write_capture
from preparation.rig_truth import rig_errors
from thermosplat.config import LensUse, Refined, TrainConfig
from thermosplat.config.files import load_config
from thermosplat.config.run_schedule import in_steps
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.trainer import Trainer

WRONG: dict[str, tuple[Disturbance, tuple[Refined, ...]]] = {
    "rig": (Disturbance(degrees=1.0, meters=0.02, focal_factor=1.05), ("rig", "intrinsics")),
    "poses": (Disturbance(pose_degrees=0.3, pose_share=0.005), ("poses",)),
}
"""What is disturbed, and what is refined where ``--refine`` does not say."""
ROWS = ("true", "refined", "as_it_is")
"""With the true cameras, and with disturbed ones that are refined, or are not."""


def settings(arguments: argparse.Namespace, refine: tuple[Refined, ...]) -> TrainConfig:
    """The configuration of one training."""
    config = load_config("demo" if arguments.small else arguments.config)
    thermal = replace(config.spectra["thermal"], source="raw")
    spectra = {**config.spectra, "thermal": thermal}
    config = replace(config, refine=refine, lens=arguments.lens, spectra=spectra, seed=arguments.seed)
    if arguments.small:
        density = replace(config.densification, max_gaussians=4000)
        config = replace(config, densification=density, decoder=replace(config.decoder, hidden_dim=16))
    return config if arguments.max_steps is None else replace(in_steps(config), max_steps=arguments.max_steps)


class Rounds:
    """Says after each round of a training how far its thermal camera is off.

    Args:
        errors: The errors [px] of a capture with corrected cameras.
    """

    def __init__(self, errors: Callable[[Capture], NDArray[np.float64]]) -> None:
        self.errors, self.number, self.began = errors, 0, time.perf_counter()
        self.found: torch.Tensor | None = None

    def __call__(self, trainer: Trainer) -> None:
        """Called after each step."""
        corrections = trainer.state.corrections
        if corrections is None or not corrections.registered:
            return
        found = corrections.cameras[list(corrections.registered)].detach().clone()
        if self.found is None or not torch.equal(found, self.found):
            errors, seconds = self.errors(trainer.corrected_capture()), time.perf_counter() - self.began
            where = f"median {np.median(errors):.2f} px, 95% {np.percentile(errors, 95):.2f} px"
            print(f"round {self.number}, step {trainer.step:,}: {where}, after {seconds:.0f} s", flush=True)
            self.found, self.number = found, self.number + 1


def measured(
    arguments: argparse.Namespace, name: str, wrong: Disturbance, refine: tuple[Refined, ...]
) -> dict[str, Any]:
    """Train on one of the captures and compare its cameras with the truth."""
    config = settings(arguments, refine)
    folder = arguments.out / name
    if not (folder / "sparse").is_dir():
        write_capture(arguments.source, arguments.points, folder, wrong, (4, 2) if arguments.small else (1, 1))
    capture = load_capture(folder, spectra=config.spectra, lens=config.lens)
    run = RunDirectory.create(arguments.out / f"run_{name}_{'_'.join(refine) or 'as_it_is'}", overwrite=True)
    trainer = Trainer(config, capture, run)
    if arguments.rounds:
        trainer.between_steps = Rounds(lambda found: thermal_errors(arguments.source, found, capture, wrong))
    metrics = trainer.train()
    errors = thermal_errors(arguments.source, trainer.corrected_capture(), capture, wrong)
    of_poses = rig_errors(run.refined if refine else folder / "sparse/0", arguments.source / "truth.json")
    return {
        "cameras": name,
        "refine": " ".join(refine) or "-",
        "median_px": float(np.median(errors)),
        "px_95": float(np.percentile(errors, 95)),
        "degrees": of_poses.degrees,
        "extent": of_poses.extent,
        **{spectrum: metrics[spectrum]["psnr"] for spectrum in ("rgb", "thermal")},
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    lines = [
        "| cameras | --refine | thermal [px], median | 95% | poses [°] | [% of extent] | RGB [dB] | thermal [dB] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['cameras']} | {row['refine']} | {row['median_px']:.2f} | {row['px_95']:.2f} | {row['degrees']:.3f} | "
        f"{100 * row['extent']:.3f} | {row['rgb']:.2f} | {row['thermal']:.2f} |"
        for row in rows
    ]
    return "\n".join(lines)


def main() -> None:
    """Train all, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="folder with visible/, thermal/ and truth.json")
    parser.add_argument("--points", type=Path, required=True, help="COLMAP model with points of the same scene")
    parser.add_argument("--small", action="store_true", help="small images and the preset demo, for a CPU")
    parser.add_argument("--config", default="thermosplat", help="preset at full size")
    parser.add_argument("--max-steps", type=int, help="in place of the preset's")
    parser.add_argument("--seed", type=int, default=42, help="of the trainings")
    parser.add_argument("--wrong", nargs="+", choices=WRONG, default=["rig"], help="what is disturbed")
    parser.add_argument("--refine", nargs="+", choices=get_args(Refined), help="in place of what is disturbed")
    parser.add_argument("--lens", choices=get_args(LensUse), default="undistort", help="as of thermosplat-train")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS, help="which trainings")
    parser.add_argument("--rounds", action="store_true", help="print the thermal camera's error after every round")
    parser.add_argument("--true-too", action="store_true", help="refine the true cameras, too")
    parser.add_argument("--out", type=Path, default=Path("results/refinement"), help="where captures and runs go")
    arguments = parser.parse_args()
    cases: list[tuple[str, Disturbance, tuple[Refined, ...]]] = []
    if "true" in arguments.rows:
        cases += [("true", Disturbance(), ())]
    for wrong in arguments.wrong:
        disturbance, refine = WRONG[wrong]
        refine = cast("tuple[Refined, ...]", tuple(arguments.refine or refine))
        disturbed = f"disturbed_{wrong}"
        cases += [(disturbed, disturbance, refine)] if "refined" in arguments.rows else []
        cases += [(disturbed, disturbance, ())] if "as_it_is" in arguments.rows else []
        cases += [("true", Disturbance(), refine)] if arguments.true_too else []
    rows = []
    for case in cases:
        rows.append(measured(arguments, *case))
        environment = {"cores": os.cpu_count(), "command": sys.argv}
        print(table(rows[-1:]), flush=True)
        write_text(arguments.out / "refinement.json", json.dumps({"environment": environment, "rows": rows}, indent=1))
    print(table(rows))


if __name__ == "__main__":
    main()
