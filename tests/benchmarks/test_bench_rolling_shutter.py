"""The rolling shutter benchmark films a scene line by line, trains with and without its shutter, and judges both."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from benchmark_scripts import run_script
from capture_folders import write_rgbt_scenes
from preparation.shutter_capture import HandHeld, Readouts, line_by_line, still_image, write_capture
from thermosplat.cli import train
from thermosplat.datasets import load_capture
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.frame_tensors import view_tensors
from thermosplat.evaluation.loaded_run import load_run

TINY = ["--config", "demo", "--max-steps", "1", "--device", "cpu", "--no-tensorboard"]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A training on temperatures that has hardly begun."""
    capture = write_rgbt_scenes(tmp_path / "rooms", raw=True)
    result = tmp_path / "truth"
    assert train.main([str(capture), *TINY, "--thermal.source", "raw", "--result-dir", str(result)]) == 0
    return result


def test_a_film_is_read_line_by_line(run: Path, tmp_path: Path) -> None:
    """A camera that stands still has lines of one image; the poses at both ends are half a readout away."""
    truth = load_run(str(run), device="cpu")
    capture = truth.capture(None)
    viewmats = np.stack([frame.views["thermal"].viewmat for frame in capture.train])
    path = HandHeld.through(viewmats, 1.0, 0.5)
    camera = Camera(20.0, 20.0, 8.0, 6.0, 16, 12)
    at_once = line_by_line(truth, camera, path, 0.3, 0.0)
    rolling = line_by_line(truth, camera, path, 0.3, 0.2)
    assert at_once.shape == (12, 16, 1)
    assert not torch.equal(rolling, at_once)
    film = write_capture(
        truth, capture, tmp_path / "film", path, Readouts(np.array([0.0, 0.5, 1.0]), 0.1), 16, (0.0, 0.0)
    )
    np.testing.assert_allclose(film.ends[1, 1], path.viewmat(0.55))
    read = load_capture(tmp_path / "film", test_every=2)
    view = view_tensors(read.train[0].views["thermal"], None, "cpu")
    np.testing.assert_allclose(view.viewmat, path.viewmat(0.5), atol=1e-5)
    assert (view.width, view.height) == (16, 12)
    celsius = cv2.imread(str(tmp_path / "film/images/thermal/0001.png"), cv2.IMREAD_UNCHANGED) / 100 - 273.15
    low, high = film.celsius
    shown = line_by_line(truth, film.cameras["thermal"], path, 0.5, 0.1)[..., 0].numpy()
    np.testing.assert_allclose(celsius, low + shown * (high - low), atol=0.0051)
    assert still_image(truth, view, "thermal").shape == (12, 16, 1)


@pytest.mark.slow
def test_rolling_shutter_benchmark_runs(run: Path, tmp_path: Path) -> None:
    """Each row is a training; what is finished is not trained again."""
    options = ["--out", str(tmp_path / "out"), "--frames", "6", "--width", "16", "--device", "cpu"]
    done = run_script("bench_rolling_shutter.py", str(run), *options, "--told", "at once", "readout", "--", *TINY)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "out" / "rolling_shutter.json").read_text())["rows"]
    assert [row["told"] for row in rows] == ["at once", "readout"]
    assert all(math.isfinite(row[name]) for row in rows for name in ("as_read", "at_rest", "slopes", "others"))
    assert not (tmp_path / "out" / "capture_at_once" / "shutter.json").exists()
    stated = json.loads((tmp_path / "out" / "capture_readout" / "shutter.json").read_text())
    assert stated["thermal"] == {"readout": pytest.approx(1 / 30), "interval": pytest.approx(0.1)}
    assert "readout time; the motion from neighbouring frames" in done.stdout
