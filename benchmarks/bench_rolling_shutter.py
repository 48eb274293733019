"""What does a scene gain when training knows that thermal images are read line by line?

    thermosplat-train data/rgbt_synthetic/desk --thermal.source raw --result-dir results/desk
    python benchmarks/bench_rolling_shutter.py results/desk --out results/shutter -- --config thermosplat

The scene of the run is the truth. A hand-held camera films it; the lines of its thermal images are read over
``--readout`` seconds (preparation/shutter_capture.py). The film is trained on as if each image were taken at once, with
the motion that neighbouring frames' poses tell (``shutter.json`` with "readout"), and with the true one ("poses"), with
each ``--lens``. Flags behind "--" go to all trainings. What is there, images and finished trainings, is not done again.

The scenes are judged by held-out images as they were read, and by what a camera at rest would see from there, which
only the truth knows: PSNR [dB], and the share of the image's slopes that is right, of the squares of differences of
neighbouring pixels. It falls with blur, and with contours at the wrong place.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)
import numpy as np
import torch
from torch import Tensor

from preparation.shutter_capture import ROLLING, Film, HandHeld, Readouts, still_image, write_capture
from thermosplat.config import LensUse
from thermosplat.datasets import load_capture
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.evaluation.loaded_run import LoadedRun, load_run
from thermosplat.image_quality.metrics import psnr
from thermosplat.runs.atomic_writes import write_text

TOLD = {
    "at once": "nothing: images are taken at once",
    "readout": "readout time; the motion from neighbouring frames",
    "poses": "true poses at the first and the last line",
}
"""What training is told of the shutter."""


def shutter_file(told: str, film: Film, readouts: Readouts) -> dict[str, Any] | None:
    """The content of ``shutter.json``; None: no file."""
    if told == "at once":
        return None
    if told == "readout":
        interval = float(readouts.times[1] - readouts.times[0])
        return {ROLLING: {"readout": readouts.seconds, "interval": interval}}
    return {ROLLING: {"poses": {f"{number:04d}.png": pair.tolist() for number, pair in enumerate(film.ends)}}}


def capture_with(told: str, film_folder: Path, out: Path, film: Film, readouts: Readouts) -> Path:
    """The film as a capture that says so much of its shutter."""
    folder = out / f"capture_{told.replace(' ', '_')}"
    folder.mkdir(parents=True, exist_ok=True)
    for part in ("images", "sparse"):
        if not (folder / part).exists():
            os.symlink((film_folder / part).resolve(), folder / part)
    content = shutter_file(told, film, readouts)
    if content is not None:
        write_text(folder / "shutter.json", json.dumps(content))
    return folder


def trained(capture: Path, run: Path, lens: str, seed: int, film: Film, flags: list[str]) -> Path:
    """The result folder of a training, which is done if it is not."""
    if not (run / "metrics.json").is_file():
        low, high = map(str, film.celsius)
        command = [sys.executable, "-m", "thermosplat", "train", str(capture), "--lens", lens, "--seed", str(seed)]
        command += [f"--{ROLLING}.source", "raw", f"--{ROLLING}.range", low, high]
        subprocess.run([*command, "--result-dir", str(run), "--overwrite", *flags], check=True)
    return run


@torch.no_grad()
def judged(truth: LoadedRun, run: Path, capture: Path) -> dict[str, float]:
    """Numbers of a scene: PSNR against images as they were read, and PSNR and slopes against a camera at rest."""
    loaded = load_run(str(run), device=str(truth.device))
    config = loaded.config
    held_out = load_capture(capture, lens=config.lens, test_every=config.test_every, spectra=config.spectra).test
    decibels, slopes = [], []
    for frame in held_out:
        view = view_tensors(frame.views[ROLLING], None, loaded.device)
        resting = view_at_rest(view)
        true, found = (still_image(one, resting, ROLLING) for one in (truth, loaded))
        decibels.append(psnr(found, true))
        slopes.append(right_slopes(found, true))
    metrics = json.loads((run / "metrics.json").read_text())
    photographs = [metrics[name]["psnr"] for name in metrics["spectra"] if name != ROLLING]
    return {
        "as_read": metrics[ROLLING]["psnr"],
        "at_rest": float(np.mean(decibels)),
        "slopes": float(np.mean(slopes)),
        "others": float(np.mean(photographs)) if photographs else float("nan"),
        "seconds": metrics["train_seconds"],
        "gaussians": metrics["num_gaussians"],
    }


def view_at_rest(view: ViewTensors) -> ViewTensors:
    """The view by a camera that does not move while it is read."""
    return replace(view, readout=None, image=None, intensity=None, values=None)


def right_slopes(found: Tensor, true: Tensor) -> float:
    """1 minus the squared error of differences of neighbouring pixels, as a share of the squared differences."""
    wrong = sum(float((found - true).diff(dim=axis).square().sum()) for axis in (0, 1))
    return 1.0 - wrong / sum(float(true.diff(dim=axis).square().sum()) for axis in (0, 1))


def line(lens: str, told: str, rows: list[dict[str, float]]) -> str:
    """A row of the table: means over the seeds, of decibels with their standard deviation."""
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    spread = {name: float(np.std([row[name] for row in rows], ddof=1)) if len(rows) > 1 else None for name in rows[0]}
    shown = [
        f"{means[name]:.2f}" + ("" if spread[name] is None else f" ± {spread[name]:.2f}")
        for name in ("as_read", "at_rest")
    ]
    photographs = "-" if np.isnan(means["others"]) else f"{means['others']:.2f}"
    return (
        f"| {lens} | {TOLD[told]} | {shown[0]} | {shown[1]} | {100 * means['slopes']:.1f} | {photographs} | "
        f"{means['gaussians']:,.0f} | {means['seconds']:.0f} |"
    )


def main() -> None:
    """Film, train, judge; print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a training on temperatures, whose scene is filmed")
    parser.add_argument("--out", type=Path, default=Path("results/shutter"))
    parser.add_argument("--frames", type=int, default=48, help="of the film")
    parser.add_argument("--interval", type=float, default=0.1, help="between frames [s]")
    parser.add_argument("--readout", type=float, default=1 / 30, help="from the first line to the last [s]")
    parser.add_argument("--arc", type=float, default=120.0, help="of the way round the scene [degrees]")
    parser.add_argument("--width", type=int, default=160, help="of the images [px]")
    parser.add_argument("--radial", type=float, nargs=2, default=(-0.24, 0.07), help="k1 and k2 of the thermal lens")
    parser.add_argument("--lens", nargs="+", choices=get_args(LensUse), default=["direct"], help="of thermosplat-train")
    parser.add_argument("--told", nargs="+", choices=TOLD, default=list(TOLD), help="rows of the table")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="one training of each kind per seed")
    parser.add_argument("--device", default="auto")
    own, flags = sys.argv[1:], []
    if "--" in own:
        own, flags = own[: own.index("--")], own[own.index("--") + 1 :]
    options = parser.parse_args(own)
    truth = load_run(str(options.run), device=options.device)
    truth.model.unscented = True  # pinhole cameras see the truth as lenses and shutters do
    capture = truth.capture(None)
    readouts = Readouts(options.interval * np.arange(options.frames), options.readout)
    taken = np.stack([frame.views[ROLLING].viewmat for frame in capture.train if ROLLING in frame.views])
    path = HandHeld.through(taken, options.interval * options.frames, np.radians(options.arc))
    began = time.perf_counter()
    film = write_capture(truth, capture, options.out / "film", path, readouts, options.width, tuple(options.radial))
    print(f"{options.frames} frames were filmed in {time.perf_counter() - began:.0f} s", flush=True)
    device = torch.cuda.get_device_name() if truth.device.type == "cuda" else f"CPU, {os.cpu_count()} cores"
    turns = [np.degrees(np.arccos(np.clip((np.trace(b[:3, :3] @ a[:3, :3].T) - 1) / 2, -1, 1))) for a, b in film.ends]
    focal = film.cameras[ROLLING].fx
    lines = [
        f"{time.strftime('%Y-%m-%d')}, {platform.machine()} {device}, torch {torch.__version__}; "
        f"{options.frames} frames of {film.cameras[ROLLING].width}x{film.cameras[ROLLING].height} px, one each "
        f"{options.interval:g} s, read over {1000 * options.readout:.0f} ms. Meanwhile the camera turns by "
        f"{np.median(turns):.2f} degrees ({focal * np.radians(np.median(turns)):.1f} px) in the median, by "
        f"{max(turns):.2f} at most. {' '.join(flags)}",
        "",
        "| --lens | shutter.json says | thermal, held out, as read | as a camera at rest sees it | right slopes [%] "
        "| photographs | Gaussians | [s] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    rows = []
    for lens in options.lens:
        for told in options.told:
            folder = capture_with(told, options.out / "film", options.out, film, readouts)
            found = []
            for seed in options.seeds:
                run = options.out / f"{lens}_{told.replace(' ', '_')}_{seed}"
                found.append(judged(truth, trained(folder, run, lens, seed, film, flags), folder))
                rows.append({"lens": lens, "told": told, "seed": seed, **found[-1]})
            lines.append(line(lens, told, found))
            print(lines[-1], flush=True)
            write_text(options.out / "rolling_shutter.json", json.dumps({"command": sys.argv, "rows": rows}, indent=1))
            write_text(options.out / "rolling_shutter.md", "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
