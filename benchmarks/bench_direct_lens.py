"""What does it cost to undistort thermal images? A rig with two distorted lenses, trained both ways.

    python benchmarks/bench_direct_lens.py RIG_DESK --out results/direct_lens --data-factor 4 -- --max-steps 1000

RIG_DESK is a folder of rendered photographs and temperatures with the true cameras (visible/, thermal/, truth.json:
OPENCV lenses in one rig, camera_to_world of the photographs); --points names a COLMAP model of the scene to start from,
without which training starts from random points. The folder becomes a capture with true cameras, which is trained on
with --lens undistort and with --lens direct; flags behind "--" go to both trainings. A finished training is not done
again. Both scenes are then compared with the same held-out images, first as they were taken, then undistorted. The
number that a training reports of itself is of its own kind of images, and comes last.
"""

import argparse
import json
import math
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)
import numpy as np
import pycolmap
import torch
from torch import Tensor
from torch.nn import functional

from thermosplat.datasets import load_capture
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.evaluation.held_out import rendered_views
from thermosplat.evaluation.loaded_run import load_run
from thermosplat.runs.atomic_writes import write_text
from thermosplat.scene.lens_slopes import bent, straightened
from thermosplat.spectra import label

LENSES = ("undistort", "direct")


def write_capture(rig: Path, points: Path | None, folder: Path) -> None:
    """The folder of a rig as a capture: links to its images, and a COLMAP model of its true cameras."""
    truth = json.loads((rig / "truth.json").read_text())
    model = folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    (folder / "images").mkdir(exist_ok=True)
    for name, source in (("rgb", "visible"), ("thermal", "thermal")):
        if not (folder / "images" / name).exists():
            os.symlink((rig / source).resolve(), folder / "images" / name)
    numbers = ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    cameras = [
        f"{number} OPENCV " + " ".join(str(truth[name][key]) for key in numbers)
        for number, name in ((1, "visible"), (2, "thermal"))
    ]
    from_visible = np.linalg.inv(np.array(truth["thermal_to_visible"]))
    thermal = sorted(path.name for path in (rig / "thermal").iterdir())
    frames, images = [], []
    for index, (name, pose) in enumerate(sorted(truth["camera_to_world"].items())):
        viewmat = np.linalg.inv(np.array(pose))
        first, second = 2 * index + 1, 2 * index + 2
        frames.append(f"{index + 1} 1 {_pose(viewmat)} 2 CAMERA 1 {first} CAMERA 2 {second}")
        images.append(f"{first} {_pose(viewmat)} 1 rgb/{name}\n")
        images.append(f"{second} {_pose(from_visible @ viewmat)} 2 thermal/{thermal[index]}\n")
    texts = {
        "cameras.txt": cameras,
        "rigs.txt": [f"1 2 CAMERA 1 CAMERA 2 1 {_pose(from_visible)}"],
        "frames.txt": frames,
        "images.txt": images,
        "points3D.txt": _points(points),
    }
    for name, lines in texts.items():
        write_text(model / name, "\n".join(lines) + "\n")


def _pose(viewmat: np.ndarray) -> str:
    x, y, z, w = pycolmap.Rotation3d(viewmat[:3, :3]).quat
    return " ".join(repr(float(number)) for number in (w, x, y, z, *viewmat[:3, 3]))


def _points(model: Path | None) -> list[str]:
    if model is None:
        return []
    found = pycolmap.Reconstruction(str(model)).points3D
    return [f"{number} {' '.join(map(str, (*p.xyz, *p.color)))} {p.error}" for number, p in found.items()]


def trained(capture: Path, out: Path, lens: str, seed: int, data_factor: int, flags: list[str]) -> Path:
    """The result folder of a training, which is done if it is not."""
    run = out / f"{lens}_{seed}"
    if not (run / "metrics.json").is_file():
        command = [sys.executable, "-m", "thermosplat", "train", str(capture), "--lens", lens, "--seed", str(seed)]
        command += ["--data-factor", str(data_factor), "--result-dir", str(run), "--overwrite", *flags]
        subprocess.run(command, check=True)
    return run


ROWS = {
    "untouched, all pixels": "both rendered through the lens",
    "untouched, pixels that both kinds of images show": "both rendered through the lens",
    "untouched, the same pixels": "each rendered as it was trained; undistort is then bent",
    "undistorted": "each rendered as it was trained; direct is then undistorted",
    "undistorted, the same": "both rendered as pinholes",
    "each its own kind": "each rendered as it was trained: **other images, not comparable**",
}
"""What is compared with: held-out images, and how the scenes are rendered."""


def judged(run: Path, capture: Path, data_factor: int) -> dict[str, Any]:
    """By spectrum a scene's PSNR [dB] against held-out images of both kinds; its Gaussians, and seconds of training.

    Returns:
        "numbers": by spectrum one number for each held-out view and each of ``ROWS``. "gaussians" and "seconds": of
        the training.
    """
    loaded = load_run(str(run), device="auto")
    config, model = loaded.config, loaded.model
    how: dict[str, Any] = {"test_every": config.test_every, "spectra": config.spectra, "data_factor": data_factor}
    untouched, resampled = load_capture(capture, lens="direct", **how), load_capture(capture, **how)
    rows: dict[str, list[list[float]]] = {name: [] for name in model.spectra}
    for frame, other in zip(untouched.test, resampled.test, strict=True):
        pinholes = rendered_views(model, other, resampled.scales, loaded.sh_degree)
        straight = {view.spectrum: view for view in pinholes}
        for view in rendered_views(model, frame, untouched.scales, loaded.sh_degree):
            pinhole = straight[view.spectrum]
            places = places_in(other.views[view.spectrum].camera, view.camera)
            inside = (places.abs() < 1).all(dim=-1)
            curved = sampled(pinhole.image, places, "bicubic")
            unbent = sampled(view.image, bent_places(pinhole.camera, view.camera), "bilinear")
            through, straightly = view.image - view.target, pinhole.image - pinhole.target
            direct = config.lens == "direct"
            found = (
                through,
                through[inside],
                through[inside] if direct else (curved - view.target)[inside],
                unbent - pinhole.target if direct else straightly,
                straightly,
                through if direct else straightly,
            )
            rows[view.spectrum].append([decibels(error.square().mean()) for error in found])
    metrics = json.loads((run / "metrics.json").read_text())
    return {"numbers": rows, "gaussians": metrics["num_gaussians"], "seconds": metrics["train_seconds"]}


def sampled(image: Tensor, places: Tensor, mode: str) -> Tensor:
    """An image [H, W, C] at places [h, w, 2] from -1 to 1, clamped to [0, 1]; the border goes on outside."""
    found = functional.grid_sample(
        image.permute(2, 0, 1)[None], places[None], mode=mode, align_corners=False, padding_mode="border"
    )
    return found[0].permute(1, 2, 0).clamp(0, 1)


def decibels(error: Tensor) -> float:
    """PSNR [dB] of a mean squared error of images in [0, 1]."""
    return -10 * math.log10(max(float(error), 1e-12))


def places_in(pinhole: Camera, view: ViewTensors) -> Tensor:
    """Where pixels of a view through a lens lie in the undistorted image, [H, W, 2], from -1 to 1 within it."""
    y, x = torch.meshgrid(torch.arange(view.height) + 0.5, torch.arange(view.width) + 0.5, indexing="ij")
    K = view.K.cpu()
    bent_slopes = (torch.stack([x, y], dim=-1) - K[:2, 2]) / K.diagonal()[:2]
    slopes = straightened(bent_slopes.to(view.K.device), view)
    scale = slopes.new_tensor([2 * pinhole.fx / pinhole.width, 2 * pinhole.fy / pinhole.height])
    start = slopes.new_tensor([2 * pinhole.cx / pinhole.width - 1, 2 * pinhole.cy / pinhole.height - 1])
    return slopes * scale + start


def bent_places(pinhole: ViewTensors, view: ViewTensors) -> Tensor:
    """Where pixels of an undistorted view lie in the image through the lens, [h, w, 2], from -1 to 1 within it."""
    y, x = torch.meshgrid(torch.arange(pinhole.height) + 0.5, torch.arange(pinhole.width) + 0.5, indexing="ij")
    K = pinhole.K
    slopes = (torch.stack([x, y], dim=-1).to(K.device) - K[:2, 2]) / K.diagonal()[:2]
    pixels = bent(slopes, view) * view.K.diagonal()[:2] + view.K[:2, 2]
    return 2 * pixels / pixels.new_tensor([view.width, view.height]) - 1


@torch.no_grad()
def main() -> None:
    """Prints and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rig", type=Path)
    parser.add_argument("--points", type=Path, default=None, help="COLMAP model whose points training starts from")
    parser.add_argument("--out", type=Path, default=Path("results/direct_lens"))
    parser.add_argument("--data-factor", type=int, default=4)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="one training of each kind per seed")
    own, flags = sys.argv[1:], []
    if "--" in own:
        own, flags = own[: own.index("--")], own[own.index("--") + 1 :]
    options = parser.parse_args(own)
    capture = options.out / "capture"
    write_capture(options.rig, options.points, capture)
    found: dict[str, list[dict[str, Any]]] = {lens: [] for lens in LENSES}
    for seed in options.seeds:
        for lens in LENSES:
            run = trained(capture, options.out, lens, seed, options.data_factor, flags)
            found[lens].append(judged(run, capture, options.data_factor))
            write_text(options.out / "direct_lens.json", json.dumps({"command": sys.argv, **found}, indent=1))
    device = "CUDA" if torch.cuda.is_available() else f"CPU, {os.cpu_count()} cores"
    seeds = " ".join(map(str, options.seeds))
    lines = [
        f"{time.strftime('%Y-%m-%d')}, {platform.machine()} {device}, torch {torch.__version__}; "
        f"--data-factor {options.data_factor} --seeds {seeds} {' '.join(flags)}. PSNR [dB], mean over held-out views "
        "and seeds.",
        "",
        "| spectrum | held-out images | rendered | undistort | direct | difference |",
        "|---|---|---|---|---|---|",
    ]
    by_view = []
    for name in found["direct"][0]["numbers"]:
        old, new = (np.array([one["numbers"][name] for one in found[lens]]) for lens in LENSES)  # [seeds, views, rows]
        for row, (images, rendered) in enumerate(ROWS.items()):
            before, after = old[..., row].mean(), new[..., row].mean()
            lines.append(
                f"| {label(name)} | {images} | {rendered} | {before:.2f} | {after:.2f} | {after - before:+.2f} |"
            )
        for seed, differences in zip(options.seeds, (new - old)[..., 0], strict=True):
            shown = ", ".join(f"{difference:+.2f}" for difference in differences)
            by_view.append(f"- {label(name)}, seed {seed}: {shown}; median {np.median(differences):+.2f}.")
    seconds, counts = (
        [float(np.mean([one[what] for one in found[lens]])) for lens in LENSES] for what in ("seconds", "gaussians")
    )
    lines += [
        "",
        "Differences of the first row by held-out view:",
        "",
        *by_view,
        "",
        f"Training took {seconds[0]:.0f} s and {seconds[1]:.0f} s ({seconds[1] / seconds[0]:.2f} times), and ended "
        f"with {counts[0]:,.0f} and {counts[1]:,.0f} Gaussians.",
    ]
    print("\n".join(lines))
    write_text(options.out / "direct_lens.md", "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
