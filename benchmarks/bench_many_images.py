"""Does training on more images than fit the memory wait for them, and does it stay within its memory?

    python benchmarks/bench_many_images.py sample --pairs 2000 --size 4000x3000 --image-memory 8
    python benchmarks/bench_many_images.py sample --pairs 300 --size 2000x1500 --image-memory 1 -- --config demo

Makes a capture of copies of the frames of another one, each image with a distorted lens, and trains on it in a process
of its own. What follows ``--`` are flags of thermosplat-train. README.md says what each row is.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)

from measuring.process_memory import memory_of
from scenes.capture_of_copies import capture_of_copies
from thermosplat.datasets import load_capture
from thermosplat.runs.atomic_writes import write_text
from training.command import apart

LOOK_EVERY_S = 0.5
"""Between looks at the memory."""
GIGABYTE = 1e9
NO_BOUND = 1e6
"""As --image-memory: every capture fits [GB]."""


def arguments(words: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The script's own options, and the flags of thermosplat-train after ``--``."""
    words, flags = apart(words)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="folder of the capture whose frames are copied, or sample")
    parser.add_argument("--pairs", type=int, default=300)
    parser.add_argument("--size", default="2000x1500", help="WIDTHxHEIGHT of the images")
    parser.add_argument("--distinct", type=int, default=8, help="pairs that are encoded; the others are links to them")
    parser.add_argument("--image-memory", type=float, default=1.0, help="as of thermosplat-train [GB]")
    parser.add_argument("--steps", type=int, default=None, help="training steps; default twice the training frames")
    parser.add_argument("--profiled", type=int, default=50, help="last steps of each epoch, on CUDA: is the GPU idle?")
    parser.add_argument("--in-memory", action="store_true", help="train once more, with all images in memory")
    parser.add_argument("--folder", type=Path, default=None, help="where the capture and the run go; default removed")
    parser.add_argument("--json", type=Path, default=None, help="file to write")
    return parser.parse_args(words), flags


def main() -> int:
    """Run the script; the exit code."""
    options, flags = arguments(sys.argv[1:])
    width, height = map(int, options.size.split("x"))
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        data = capture_of_copies(
            folder / "capture", load_capture(options.data), options.pairs, (width, height), options.distinct
        )
        report = trained(options, data, folder, options.image_memory, flags)
        report |= {"pairs": options.pairs, "size": options.size, "image_memory_gb": options.image_memory}
        print_report(report)
        if options.in_memory:
            report["in_memory"] = trained(options, data, folder, NO_BOUND, flags)
            print("with all images in memory:")
            print_epochs(report["in_memory"]["epochs"])
    if options.json is not None:
        write_text(options.json, json.dumps(report, indent=2) + "\n")
    return 0


def trained(
    options: argparse.Namespace, data: Path, folder: Path, image_memory: float, flags: list[str]
) -> dict[str, Any]:
    """What a training in a process of its own told, and the most memory that it took.

    Raises:
        SystemExit: It failed.
    """
    told = folder / "measured.json"
    words = [str(data), "--image-memory", str(image_memory), "--result-dir", str(folder / "run")]
    own = [str(told), str(options.steps), str(options.profiled)]
    started = time.time()
    process = subprocess.Popen(
        [sys.executable, "-m", "training.timed_training", *own, *words, *flags], env=os.environ | _python_path()
    )
    most = watched(process)
    if process.returncode != 0:
        raise SystemExit(process.returncode)
    return measured(json.loads(told.read_text(encoding="utf-8")), started) | most


def _python_path() -> dict[str, str]:
    """Where the other process finds the packages that this one has, and the rooms of benchmarks/."""
    return {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def watched(process: "subprocess.Popen[bytes]") -> dict[str, float]:
    """The most memory that a process and those that it starts take until it ends [GB]."""
    most = 0.0
    while process.poll() is None:
        most = max(most, memory_of(process.pid).total / GIGABYTE)
        time.sleep(LOOK_EVERY_S)
    return {"most_gb": most}


def measured(told: dict[str, Any], started: float) -> dict[str, Any]:
    """What the training told, with times from the start of its process on, and by epoch."""
    at = {name: moment - started for name, moment in told.pop("moments").items()}
    # of each step: when it ended, and the time waited until then, for frames to be read and for the device
    size, steps, windows = told["frames"], told.pop("steps"), told.pop("windows")
    report = {**told, "start_s": at, "first_step_s": steps[0][0] - started, "epochs": []}
    for start in range(0, len(steps), size):
        part = steps[start : start + size]
        if len(part) > 1:
            seconds, waited, ahead = (last - first for first, last in zip(part[0], part[-1], strict=True))
            epoch = {"steps": len(part), "step_ms": 1e3 * seconds / (len(part) - 1)}
            epoch |= {"waited": waited / seconds, "ahead": ahead / seconds}
            profiled = [window for window in windows if start < window["first_step"] <= start + size]
            report["epochs"].append(epoch | {"profiled": profiled[0] if profiled else None})
    return report


def print_report(report: dict[str, Any]) -> None:
    """The numbers, a line each."""
    print(f"{report['pairs']:,} pairs of {report['size']}, --image-memory {report['image_memory_gb']:g} GB")
    print(f"{report['frames']:,} training frames of {report['trained_size']}, {report['readers']} processes that read")
    for name, seconds in report["start_s"].items():
        print(f"{name} after {seconds:.1f} s")
    print(f"first step done after {report['first_step_s']:.1f} s")
    print(f"memory before the first step: {report['before_gb']:.2f} GB, the most of all: {report['most_gb']:.2f} GB")
    if "reading_gb" in report:
        print(f"memory that reading took without training: {report['reading_gb']:.2f} GB")
        for name, called in (("decoded", "decoded and undistorted"), ("kept", "from the disk cache")):
            rate, busy = report[f"{name}_per_s"], report[f"{name}_cpu_ms"]
            print(f"the readers alone, {called}: {rate:.1f} frames per second, {busy:.1f} ms of a core for each")
        parts = f"{report['copy_ms']:.2f} ms to the device, {report['convert_ms']:.2f} ms to make tensors of them"
        print(f"the {report['frame_mb']:.1f} MB of a frame, once they were read: {parts}")
    print_epochs(report["epochs"])


def print_epochs(epochs: list[dict[str, Any]]) -> None:
    """A line for each epoch."""
    for number, epoch in enumerate(epochs, start=1):
        waits = f"waiting for images {epoch['waited']:.1%}, for the device {epoch['ahead']:.1%}"
        print(f"epoch {number}, {epoch['steps']} steps: {epoch['step_ms']:.2f} ms per step, {waits}")
        if epoch["profiled"] is not None:
            found = epoch["profiled"]
            idle = f"GPU idle {found['idle']:.1%}, copies to it {found['to_device_ms']:.2f} ms per step"
            print(f"    profiled from step {found['first_step']} on: {found['step_ms']:.2f} ms per step, {idle}")


if __name__ == "__main__":
    sys.exit(main())
