"""The benchmark of captures that do not fit the memory: the capture of copies, and what is made of its notes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bench_many_images import measured
from benchmark_scripts import run_script
from measuring.process_memory import memory_of
from scenes.capture_of_copies import capture_of_copies
from thermosplat.datasets import load_capture


def test_a_capture_of_copies(tmp_path: Path) -> None:
    """Most files are links, every image is undistorted, and the poses are those of the source."""
    source = load_capture("sample", data_factor=4)
    root = capture_of_copies(tmp_path / "copies", source, 12, (64, 48), 3)
    assert {file.stat().st_nlink for file in root.rglob("*.jpg")} == {4}
    capture = load_capture(root)
    assert len(capture.train) + len(capture.test) == 12
    assert any("were undistorted" in note for note in capture.notes)
    assert len(capture.points) == len(source.points)
    first, fourth = capture.test[0], capture.train[2]
    assert (first.name, fourth.name) == ("frame_000000", "frame_000003")
    expected = source.train[0].views["rgb"].viewmat
    for frame in (first, fourth):
        assert abs(frame.views["rgb"].viewmat - expected).max() < 1e-6


def test_times_are_from_the_start_on() -> None:
    """Steps of the first epoch and later ones; the first step of each window is where it begins."""
    steps = [(100.0 + number, 0.25 * number) for number in range(6)]
    told = {"moments": {"capture known": 97.0}, "steps": steps, "frames": 3}
    report = measured(told, 90.0)
    assert report["start_s"] == {"capture known": 7.0}
    assert report["first_step_s"] == 10.0
    for name in ("first_epoch", "later"):
        assert report[name] == {"step_ms": 1000.0, "waited": 0.25}


def test_memory_is_that_of_children_too() -> None:
    """A child's memory counts as its own."""
    child = subprocess.Popen([sys.executable, "-c", "x = bytearray(b'x') * 10**8; print(1, flush=True); input()"],
                             stdin=subprocess.PIPE, stdout=subprocess.PIPE)  # fmt: skip
    try:
        assert child.stdout is not None
        child.stdout.readline()
        found = memory_of(os.getpid())
    finally:
        child.communicate(b"\n")
    assert found.children > 10**8
    assert found.process > 10**7
    assert found.total == found.process + found.children


@pytest.mark.slow
def test_the_benchmark_runs(tmp_path: Path) -> None:
    """It trains on the disk's images, and says how long that waits and what it takes."""
    report = tmp_path / "report.json"
    options = ["sample", "--pairs", "60", "--size", "96x72", "--image-memory", "0.002", "--steps", "3"]
    done = run_script(
        "bench_many_images.py", *options, "--json", str(report), "--", "--config", "demo", "--device", "cpu"
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(report.read_text())
    assert found["readers"] >= 1
    assert 0 <= found["first_epoch"]["waited"] <= 1
    assert found["decoded_per_s"] > 0
    assert found["most_gb"] > found["before_gb"] > 0
    assert found["most_gb"] > found["reading_gb"] > 0
