"""The benchmark of captures that do not fit the memory: the capture of copies, and what is made of its notes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bench_many_images import measured
from benchmark_scripts import run_script
from measuring.device_time import covered
from measuring.process_memory import memory_of
from measuring.process_time import seconds_of_children
from scenes.capture_of_copies import capture_of_copies
from thermosplat.datasets import load_capture
from training.timed_training import profiled_steps


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
    """Steps of each epoch; the first step of each is where it begins. A profile belongs to its epoch."""
    steps = [(100.0 + number, 0.25 * number, 0.5 * number) for number in range(8)]
    windows = [{"first_step": 3, "idle": 0.1}, {"first_step": 5, "idle": 0.2}]
    told = {"moments": {"capture known": 97.0}, "steps": steps, "frames": 3, "windows": windows}
    report = measured(told, 90.0)
    assert report["start_s"] == {"capture known": 7.0}
    assert report["first_step_s"] == 10.0
    assert [epoch["steps"] for epoch in report["epochs"]] == [3, 3, 2]
    assert [epoch["profiled"] for epoch in report["epochs"]] == [*windows, None]
    for epoch in report["epochs"]:
        assert (epoch["step_ms"], epoch["waited"], epoch["ahead"]) == (1000.0, 0.25, 0.5)


def test_time_in_which_a_device_is_busy() -> None:
    """Kernels on several streams count once; gaps do not."""
    assert covered([]) == 0
    assert covered([(5.0, 6.0), (0.0, 2.0), (1.0, 3.0), (1.5, 2.0)]) == 4.0


def test_profiles_end_with_epochs() -> None:
    """The last ones of each epoch that has more, but the very last; nothing is noted after the last step of all."""
    assert profiled_steps(10, 25, 5) == {9: 4, 19: 14}  # the third epoch has no more than five
    assert profiled_steps(10, 25, 3) == {9: 6, 19: 16, 24: 21}
    assert profiled_steps(10, 25, 0) == {}
    assert profiled_steps(10, 10, 3) == {9: 6}


def test_time_is_that_of_children() -> None:
    """Not of this process."""
    before = seconds_of_children(os.getpid())
    script = "import time\nwhile time.process_time() < 0.3: pass\nprint(1, flush=True); input()"
    child = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert child.stdout is not None
        child.stdout.readline()
        found = seconds_of_children(os.getpid()) - before
    finally:
        child.communicate(b"\n")
    assert 0.25 < found < 10


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
    options = ["sample", "--pairs", "60", "--size", "96x72", "--image-memory", "0.002", "--steps", "3", "--in-memory"]
    done = run_script(
        "bench_many_images.py", *options, "--json", str(report), "--", "--config", "demo", "--device", "cpu"
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(report.read_text())
    assert found["readers"] >= 1
    assert 0 <= found["epochs"][0]["waited"] <= 1
    assert found["in_memory"]["epochs"][0]["waited"] == 0
    assert min(found[name] for name in ("decoded_per_s", "kept_per_s", "frame_mb", "convert_ms")) > 0
    assert found["most_gb"] > found["before_gb"] > 0
    assert found["most_gb"] > found["reading_gb"] > 0
