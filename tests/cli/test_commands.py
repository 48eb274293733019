"""The four commands on the sample capture, run in this process; every mistake ends with code 2 and no traceback."""

import dataclasses
import json
import re
import shutil
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from thermosplat.cli import evaluate, export, render, train
from thermosplat.config_files import load_config
from thermosplat.run_lock import LOCK_FILE
from thermosplat.training.trainer import Trainer

QUICK = ["--data-factor", "4", "--device", "cpu", "--no-tensorboard", "--log-every", "1"]
STEPS = 3

Outcome = tuple[int, str]
Run = Callable[..., Outcome]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command; returns its exit code and what it printed, panels unfolded into running text."""

    def runner(main: Callable[[list[str]], int], *words: object) -> Outcome:
        capsys.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        printed = captured.out + captured.err
        assert "Traceback" not in printed
        return code, " ".join(re.sub("[│╭╮╰╯─]", " ", printed).split())

    return runner


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of a few steps on the sample capture."""
    folder = tmp_path_factory.mktemp("runs") / "finished run"
    assert train.main(["sample", *QUICK, "--max-steps", str(STEPS), "--result-dir", str(folder)]) == 0
    return folder


@pytest.fixture
def unharmed(finished: Path) -> Iterator[None]:
    """Nothing in the finished run changes during the test."""
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    yield
    assert {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()} == before


def test_training_leaves_everything_behind(finished: Path) -> None:
    """One command leaves numbers, pictures of every held-out frame, both PLYs, the checkpoint and its configuration."""
    metrics = json.loads((finished / "metrics.json").read_text())
    assert {"psnr", "ssim", "lpips"} <= set(metrics["rgb"])
    assert {"psnr", "ssim", "lpips", "mae_celsius"} <= set(metrics["thermal"])
    assert metrics["thermal"]["mae_celsius"] > 0
    assert metrics["steps"] == STEPS
    assert {"num_gaussians", "train_seconds", "device"} <= set(metrics)
    assert (finished / "ckpts" / f"step_{STEPS:06d}.pt").is_file()
    assert {path.name for path in (finished / "ply").iterdir()} == {"splat_rgb.ply", "splat_thermal.ply"}
    per_view = (finished / "stats" / "per_view.csv").read_text().splitlines()
    pictures = list((finished / "renders").glob("*.png"))
    assert len(per_view) - 1 == 2 * len(pictures) > 0
    assert all(cv2.imread(str(picture)) is not None for picture in pictures)
    config = load_config(finished / "config.yaml")
    assert (config.config, config.data, config.max_steps, config.resume) == ("demo", "sample", STEPS, None)
    lines = [json.loads(line) for line in (finished / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "loss" in line] == list(range(1, STEPS + 1))


@pytest.mark.usefixtures("unharmed")
def test_occupied_result_folder(run: Run, finished: Path) -> None:
    """A folder that holds a run is not touched; the message names both ways out."""
    code, printed = run(train.main, "sample", *QUICK, "--result-dir", finished)
    assert code == 2
    assert f"already holds a run ({STEPS} steps)" in printed
    assert "--resume" in printed
    assert "--overwrite" in printed


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize("words", [["sample", "--overwrite"], ["--max-steps", str(STEPS + 1)]])
def test_run_that_is_being_trained(run: Run, finished: Path, words: list[str]) -> None:
    """Nothing is deleted or written where another process trains."""
    lock = finished / LOCK_FILE
    lock.write_text("4711 elsewhere\n")
    try:
        folder = ["--resume", finished] if "sample" not in words else [*QUICK, "--result-dir", finished]
        code, printed = run(train.main, *words, *folder)
        assert lock.read_text() == "4711 elsewhere\n"
    finally:
        lock.unlink()
    assert code == 2
    assert "is being trained by process 4711 on elsewhere" in printed


@pytest.mark.usefixtures("unharmed")
def test_overwrite_deletes_nothing_before_the_input_is_good(run: Run, finished: Path, tmp_path: Path) -> None:
    """--overwrite with a capture that cannot be read leaves the earlier run alone."""
    for wrong in (["--data-factor", "4", "nowhere"], ["sample", "--device", "cuda:99"], [str(tmp_path)]):
        code, _ = run(train.main, *wrong, "--result-dir", finished, "--overwrite")
        assert code == 2


def test_overwrite_starts_again(run: Run, tmp_path: Path) -> None:
    """--overwrite replaces an earlier run by a new one."""
    words = ["sample", *QUICK, "--result-dir", tmp_path / "run"]
    assert run(train.main, *words, "--max-steps", 2)[0] == 0
    assert run(train.main, *words, "--max-steps", 1, "--overwrite")[0] == 0
    assert [path.name for path in (tmp_path / "run" / "ckpts").iterdir()] == ["step_000001.pt"]


def test_ctrl_c_saves_and_resume_finishes(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C ends with code 130 and a command line; that command line finishes the run without naming the capture."""
    folder = tmp_path / "run"
    whole_step = Trainer._train_step

    def interrupted(trainer: Trainer) -> None:
        if trainer.state.step == 2:
            raise KeyboardInterrupt
        whole_step(trainer)

    monkeypatch.setattr(Trainer, "_train_step", interrupted)
    code, printed = run(train.main, "sample", *QUICK, "--max-steps", 4, "--result-dir", folder)
    assert code == 130
    assert f"thermosplat-train --resume {folder}" in printed
    assert (folder / "ckpts" / "step_000002.pt").is_file()
    monkeypatch.undo()
    assert run(train.main, "--resume", folder)[0] == 0
    assert json.loads((folder / "metrics.json").read_text())["steps"] == 4
    assert run(train.main, "--resume", folder, "--max-steps", 5)[0] == 0
    assert json.loads((folder / "metrics.json").read_text())["steps"] == 5


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], "thermosplat-train sample"),
        (["no/such/folder"], "no/such/folder does not exist"),
        (["sample", "--config", "dmeo"], 'did you mean "demo"'),
        (["sample", "--config", "mine.yaml"], "no configuration file mine.yaml"),
        (["sample", "--max-step", "3"], "--max-steps"),
        (["sample", "--data-factor", "half"], "--data-factor"),
        (["sample", "--sh-degree", "7"], "--sh-degree must be at most 3"),
        (["sample", "--device", "gpu"], "gpu"),
        (["--resume", "no/such/run"], "No training run in no/such/run"),
        (["sample", "--test-every", "1"], "--test-every must be at least 2"),
    ],
)
def test_mistakes_in_train(run: Run, words: list[str], expected: str, tmp_path: Path, monkeypatch) -> None:
    """Each mistake is one message with what helps, and leaves no folder behind."""
    monkeypatch.chdir(tmp_path)
    code, printed = run(train.main, *words)
    assert code == 2
    assert expected in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")
def test_cuda_where_there_is_none(run: Run, tmp_path: Path) -> None:
    """Asking for CUDA on a machine without says so, and how to go on."""
    code, printed = run(train.main, "sample", "--device", "cuda", "--result-dir", tmp_path / "run")
    assert code == 2
    assert "no CUDA device" in printed
    assert "--device cpu" in printed


@pytest.mark.usefixtures("unharmed")
def test_resume_with_another_sh_degree(run: Run, finished: Path) -> None:
    """Resuming with a flag that contradicts the run names both values."""
    code, printed = run(train.main, "--resume", finished, "--sh-degree", "0")
    assert code == 2
    assert "was trained with sh_degree=2, the command asks for 0" in printed


@pytest.mark.parametrize("main", [evaluate.main, render.main, export.main])
def test_mistakes_in_the_siblings(run: Run, main: Callable[[list[str]], int], finished: Path, tmp_path: Path) -> None:
    """No run, no such checkpoint, a damaged checkpoint: one message each, with the steps there are."""
    code, printed = run(main, tmp_path / "nothing")
    assert code == 2
    assert "No training run" in printed
    code, printed = run(main, finished, "--step", 77)
    assert code == 2
    assert f"no checkpoint of step 77. It has: --step {STEPS}." in printed
    (tmp_path / "broken" / "ckpts").mkdir(parents=True)
    (tmp_path / "broken" / "ckpts" / "step_000009.pt").write_bytes(b"half a checkpo")
    code, printed = run(main, tmp_path / "broken")
    assert code == 2
    assert "is damaged" in printed


def test_eval_agrees_with_training(run: Run, finished: Path) -> None:
    """thermosplat-eval prints and writes the numbers that training ended with, and pictures of these frames alone."""
    stale = finished / "renders" / f"eval_{STEPS:06d}" / "desk_9999.png"
    stale.parent.mkdir(exist_ok=True)
    stale.write_bytes(b"x")
    code, printed = run(evaluate.main, finished, "--device", "cpu")
    assert code == 0
    assert not stale.exists()
    written = json.loads((finished / "stats" / f"eval_{STEPS:06d}.json").read_text())
    assert written["data"] == "sample"
    trained = json.loads((finished / "metrics.json").read_text())
    for modality in ("rgb", "thermal"):
        assert written[modality]["psnr"] == pytest.approx(trained[modality]["psnr"], rel=1e-6)
        assert f"{trained[modality]['psnr']:.2f}" in printed
    assert "PSNR [dB]" in printed
    assert list((finished / "renders" / f"eval_{STEPS:06d}").glob("*.png"))


def test_regions_of_a_capture_with_ground_truth(run: Run, finished: Path, tmp_path: Path) -> None:
    """Training leaves regions.json, thermosplat-eval makes it again and prints it; other captures have no such file."""
    assert not (finished / "regions.json").exists()
    capture, folder = tmp_path / "with_truth", tmp_path / "run"
    shutil.copytree(str(files("thermosplat") / "sample"), capture)
    (capture / "ground_truth").mkdir()
    depth, label = np.full((150, 200), 2.0, np.float32), np.zeros((150, 200), np.uint8)
    label[:, 100:] = 1
    for image in (capture / "rgb").rglob("*.jpg"):
        np.savez(capture / "ground_truth" / image.stem, depth_rgb=depth, depth_thermal=depth, label=label)
    assert run(train.main, capture, *QUICK, "--max-steps", 2, "--result-dir", folder)[0] == 0
    trained = json.loads((folder / "regions.json").read_text())
    assert trained["steps"] == 2
    assert list(trained["regions"]) == ["all", "glass", "unlabelled"]
    (folder / "regions.json").unlink()
    code, printed = run(evaluate.main, folder, "--device", "cpu")
    assert code == 0
    assert "glass" in printed
    again = json.loads((folder / "regions.json").read_text())
    for region, numbers in trained["regions"].items():
        for modality in ("rgb", "thermal"):
            known = {name: number for name, number in numbers[modality].items() if number is not None}
            found = {name: number for name, number in again["regions"][region][modality].items() if number is not None}
            assert found == pytest.approx(known, rel=1e-5)


def test_capture_that_moved(run: Run, finished: Path, tmp_path: Path) -> None:
    """A run whose capture is not where it was asks for --data."""
    state = torch.load(finished / "ckpts" / f"step_{STEPS:06d}.pt", weights_only=True)
    state["config"]["data"] = str(tmp_path / "gone")
    (tmp_path / "run" / "ckpts").mkdir(parents=True)
    torch.save(state, tmp_path / "run" / "ckpts" / f"step_{STEPS:06d}.pt")
    code, printed = run(render.main, tmp_path / "run")
    assert code == 2
    assert "which is not there" in printed
    assert "--data FOLDER" in printed
    code, _ = run(render.main, tmp_path / "run", "--data", "sample", "--path", "test", "--format", "png")
    assert code == 0
    config = (finished / "config.yaml").read_text().replace("data: sample", f"data: {tmp_path / 'gone'}")
    (tmp_path / "run" / "config.yaml").write_text(config)
    code, printed = run(train.main, "--resume", tmp_path / "run", "--max-steps", STEPS + 1)
    assert code == 2
    assert f"thermosplat-train FOLDER --resume {tmp_path / 'run'}" in printed
    code, _ = run(train.main, "sample", "--resume", tmp_path / "run", "--max-steps", STEPS + 1)
    assert code == 0


def test_another_capture_is_noticed(run: Run, finished: Path, tmp_path: Path) -> None:
    """A run does not go on with a capture that lacks one of its training frames, and evaluating there says so."""
    other = tmp_path / "other"
    shutil.copytree(str(files("thermosplat") / "sample"), other)
    for folder in ("rgb", "thermal"):
        min((other / folder / "train").iterdir()).unlink()
    for folder in ("rgb", "thermal"):
        min((other / folder / "test").iterdir()).unlink()
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    code, printed = run(train.main, other, "--resume", finished, "--max-steps", STEPS + 1)
    assert code == 2
    assert "cannot go on with another capture" in printed
    code, printed = run(evaluate.main, finished, "--data", other, "--device", "cpu")
    assert code == 0
    assert f"Is this the capture of {finished}?" in printed
    name = f"{STEPS:06d}_other"
    assert json.loads((finished / "stats" / f"eval_{name}.json").read_text())["data"] == str(other)
    assert list((finished / "renders" / f"eval_{name}").glob("*.png"))
    code, printed = run(render.main, finished, "--data", other, "--device", "cpu", "--frames", 2)
    assert code == 0
    assert f"Is this the capture of {finished}?" in printed
    assert (finished / "videos" / f"interp_both_{name}.mp4").is_file()
    assert {path: path.read_bytes() for path in before} == before  # its own results are as they were
    assert "Is this the capture" not in run(evaluate.main, finished, "--device", "cpu")[1]


def test_capture_with_other_held_out_frames_is_another(run: Run, finished: Path, tmp_path: Path) -> None:
    """Also where the training frames are the same: its numbers are not the run's."""
    other = tmp_path / "fewer"
    shutil.copytree(str(files("thermosplat") / "sample"), other)
    for folder in ("rgb", "thermal"):
        min((other / folder / "test").iterdir()).unlink()
    code, printed = run(evaluate.main, finished, "--data", other, "--device", "cpu")
    assert code == 0
    assert "other held-out frames" in printed
    assert (finished / "stats" / f"eval_{STEPS:06d}_fewer.csv").is_file()


@pytest.mark.parametrize("words", [["--frames", "0"], ["--fps", "0"], ["--path", "zigzag"], ["--modality", "sound"]])
def test_mistakes_in_render(run: Run, finished: Path, words: list[str]) -> None:
    """Impossible values of thermosplat-render's flags are refused by name."""
    code, printed = run(render.main, finished, *words)
    assert code == 2
    assert words[0] in printed


def test_render_along_a_path(run: Run, finished: Path) -> None:
    """Both spectra side by side as a video, one alone as PNGs."""
    assert run(render.main, finished, "--frames", 3, "--device", "cpu")[0] == 0
    video = cv2.VideoCapture(str(finished / "videos" / f"interp_both_{STEPS:06d}.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 3
    code, printed = run(
        render.main, finished, "--path", "ellipse", "--frames", 2, "--modality", "rgb", "--format", "png"
    )
    assert code == 0
    folder = finished / "videos" / f"ellipse_rgb_{STEPS:06d}"
    assert str(folder) in printed
    images = [cv2.imread(str(path)) for path in sorted(folder.iterdir())]
    assert len(images) == 2
    assert images[0].shape[1] * 2 == pytest.approx(video.get(cv2.CAP_PROP_FRAME_WIDTH), abs=1)
    assert not np.array_equal(images[0], images[1])
    assert run(render.main, finished, "--path", "test", "--modality", "rgb", "--format", "png")[0] == 0
    named = {path.name for path in (finished / "videos" / f"test_rgb_{STEPS:06d}").iterdir()}
    assert named == {path.name for path in (finished / "renders").glob("*.png")}


def test_export_elsewhere(run: Run, finished: Path, tmp_path: Path) -> None:
    """thermosplat-export writes the asked-for spectrum into the asked-for folder, the same as training did."""
    code, printed = run(export.main, finished, "--modality", "thermal", "--output", tmp_path / "out")
    assert code == 0
    assert "Gaussians" in printed
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["splat_thermal.ply"]
    original = finished / "ply" / "splat_thermal.ply"
    assert (tmp_path / "out" / "splat_thermal.ply").read_bytes() == original.read_bytes()
    assert run(export.main, finished, "--modality", "thermal", "--output", tmp_path / "small", "--compact")[0] == 0
    small = tmp_path / "small" / "splat_thermal.ply"
    assert small.stat().st_size < 0.35 * original.stat().st_size  # 17 of 62 properties


def test_run_of_one_spectrum(run: Run, tmp_path: Path) -> None:
    """A model of RGB alone trains, and its siblings offer RGB alone."""
    folder = tmp_path / "run"
    words = ["sample", *QUICK, "--max-steps", 1, "--model.no-thermal", "--result-dir", folder]
    assert run(train.main, *words)[0] == 0
    assert json.loads((folder / "metrics.json").read_text())["thermal"] is None
    assert run(render.main, folder, "--path", "test", "--format", "png")[0] == 0
    for main, asked in ((render.main, "both"), (export.main, "thermal")):
        code, printed = run(main, folder, "--modality", asked)
        assert code == 2
        assert "was trained" in printed


def test_config_of_a_run_reproduces_it(run: Run, finished: Path, tmp_path: Path) -> None:
    """Training again from a run's config.yaml ends with the same numbers."""
    code, _ = run(train.main, "--config", finished / "config.yaml", "--result-dir", tmp_path / "again")
    assert code == 0
    first, second = (json.loads((folder / "metrics.json").read_text()) for folder in (finished, tmp_path / "again"))
    assert second["rgb"] == first["rgb"]
    assert second["thermal"] == first["thermal"]
    configs = [load_config(folder / "config.yaml") for folder in (finished, tmp_path / "again")]
    assert dataclasses.replace(configs[1], result_dir=configs[0].result_dir) == configs[0]
