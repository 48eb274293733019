"""thermosplat-train on the sample capture, run in this process; every mistake ends with code 2 and no traceback."""

import copy
import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from functools import reduce
from importlib.resources import files
from pathlib import Path

import cv2
import pytest
import torch

from multispectral_capture import near_infrared, write_multispectral_capture
from sample_runs import QUICK, STEPS, Run
from thermosplat.cli import evaluate, export, render, train
from thermosplat.config.files import load_config
from thermosplat.config.spectrum_checks import RESERVED
from thermosplat.runs.run_lock import LOCK_FILE
from thermosplat.training.trainer import Trainer


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


@pytest.mark.rotating("commands that train")
def test_size_of_the_model_is_said(run: Run, tmp_path: Path) -> None:
    """Gaussians and bytes; with a budget what it has left of latent channels and offsets; the blur of cameras."""
    words = ["sample", *QUICK, "--max-steps", 1, "--result-dir"]
    _, printed = run(train.main, *words, tmp_path / "fixed")
    metrics = json.loads((tmp_path / "fixed" / "metrics.json").read_text())
    assert f"Model: {metrics['num_gaussians']:,} Gaussians; {metrics['model_bytes'] / 1e6:.1f} MB." in printed
    assert "Blur" not in printed
    _, printed = run(train.main, *words, tmp_path / "auto", "--budget", "auto", "--thermal.point-spread", "0.003")
    assert "Blur of thermal images: 0.30% of their width (standard deviation)." in printed
    metrics = json.loads((tmp_path / "auto" / "metrics.json").read_text())
    kept = metrics["opacity_offsets_kept"]["thermal"]
    left = f"{metrics['feature_channels']} of 8 latent channels, {kept:.0%} of the thermal"
    assert f"Model: {metrics['num_gaussians']:,} Gaussians, {left} offsets; " in printed
    _, printed = run(train.main, *words, tmp_path / "3dgs", "--budget", "auto", "--config", "3dgs")
    assert re.search(r"Model: [\d,]+ Gaussians; [\d.]+ MB\.", printed)


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


@pytest.mark.rotating("commands that train")
def test_overwrite_starts_again(run: Run, tmp_path: Path) -> None:
    """--overwrite replaces an earlier run by a new one."""
    words = ["sample", *QUICK, "--result-dir", tmp_path / "run"]
    assert run(train.main, *words, "--max-steps", 2)[0] == 0
    assert run(train.main, *words, "--max-steps", 1, "--overwrite")[0] == 0
    assert [path.name for path in (tmp_path / "run" / "ckpts").iterdir()] == ["step_000001.pt"]


@pytest.mark.rotating("commands that train")
def test_ctrl_c_saves_and_resume_finishes(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C ends with code 130 and a command line; that command line finishes the run without naming the capture."""
    folder = tmp_path / "run"
    whole_step = Trainer.train_step

    def interrupted(trainer: Trainer) -> None:
        if trainer.state.step == 2:
            raise KeyboardInterrupt
        whole_step(trainer)

    monkeypatch.setattr(Trainer, "train_step", interrupted)
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
        (["sample", "--sh-degree", "7"], "--sh-degree must be at most 4"),
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


@pytest.mark.rotating("commands that train")
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


@pytest.mark.rotating("commands that train")
def test_a_capture_named_on_resume_is_found_from_anywhere(
    run: Run, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A relative path to the capture is kept as an absolute one, as that of a new run."""
    shutil.copytree(str(files("thermosplat") / "sample"), tmp_path / "captures" / "desk")
    shutil.copytree(finished, tmp_path / "run")
    monkeypatch.chdir(tmp_path / "captures")
    code, _ = run(train.main, "desk", "--resume", tmp_path / "run", "--max-steps", STEPS + 1)
    assert code == 0
    assert load_config(tmp_path / "run" / "config.yaml").data == str(tmp_path / "captures" / "desk")
    monkeypatch.chdir(tmp_path)
    assert run(evaluate.main, tmp_path / "run", "--device", "cpu")[0] == 0


@pytest.mark.rotating("commands that train")
def test_run_of_one_spectrum(run: Run, tmp_path: Path) -> None:
    """A model of RGB alone trains, and its siblings offer RGB alone."""
    folder = tmp_path / "run"
    words = ["sample", *QUICK, "--max-steps", 1, "--without", "thermal", "--result-dir", folder]
    assert run(train.main, *words)[0] == 0
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["spectra"] == ["rgb"]
    assert "thermal" not in metrics
    assert run(render.main, folder, "--path", "test", "--format", "png")[0] == 0
    for main, asked in ((render.main, "both"), (export.main, "thermal")):
        for flag in ("--spectra", "--modality"):
            code, printed = run(main, folder, flag, asked)
            assert code == 2
            assert f"The run was trained on RGB images, not on {asked}. Give --spectra rgb." in printed


@pytest.mark.rotating("commands that train")
def test_run_of_three_spectra(run: Run, tmp_path: Path) -> None:
    """A spectrum that a configuration file defines is trained, gone on with, measured in its unit, shown, exported."""
    capture = write_multispectral_capture(tmp_path / "capture", {"nir": near_infrared}, thermal=True, depth=16)
    (tmp_path / "nir.yaml").write_text("base: demo\nspectra:\n  nir: {unit: reflectance}\n")
    folder, small = tmp_path / "run", ["--data-factor", 5, "--device", "cpu"]
    words = [capture, "--config", tmp_path / "nir.yaml", *small, "--no-tensorboard", "--nir.factor", 1 / 65535]
    assert run(train.main, *words, "--max-steps", 2, "--result-dir", folder)[0] == 0
    config = load_config(folder / "config.yaml")
    assert config.spectra["nir"].factor == pytest.approx(1 / 65535)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["spectra"] == ["rgb", "thermal", "nir"]
    assert 0 < metrics["nir"]["mae_reflectance"] < 1
    assert metrics["nir"].keys() - metrics["rgb"].keys() == {"mae_reflectance", "bias_reflectance"}
    for key in metrics.keys() - set(metrics["spectra"]):  # a spectrum of that name would take its place
        assert key in RESERVED | {field.name for field in dataclasses.fields(config)}
    rows = (folder / "stats" / "per_view.csv").read_text().splitlines()
    assert [line.split(",")[1] for line in rows[1:4]] == ["rgb", "thermal", "nir"]
    assert {path.name for path in (folder / "ply").iterdir()} == {f"splat_{n}.ply" for n in metrics["spectra"]}
    assert run(train.main, "--resume", folder, "--max-steps", 3, "--nir.factor", 1 / 65535)[0] == 0
    code, printed = run(train.main, "--resume", folder, "--nir.factor", 0.5)
    assert code == 2
    assert "was trained with spectra.nir.factor=" in printed
    code, printed = run(evaluate.main, folder)
    assert code == 0
    assert re.search(r"thermal .* [\d.]+ °C", printed)
    assert re.search(r"NIR .* [\d.]+ reflectance", printed)
    assert "NIR" in printed
    for shown, name in (([], "rgb-thermal-nir"), (["--spectra", "nir", "rgb"], "rgb-nir")):
        assert run(render.main, folder, "--path", "test", "--format", "png", *shown)[0] == 0
        images = sorted((folder / "videos" / f"test_{name}_000003").iterdir())
        assert cv2.imread(str(images[0])).shape == (30, 40 * len(name.split("-")), 3)
    assert run(export.main, folder, "--spectra", "nir", "--output", tmp_path / "out", "--fit-passes", 0)[0] == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["splat_nir.ply"]


def test_a_spectrum_that_nobody_defined(run: Run, tmp_path: Path) -> None:
    """Images of it in the capture are not read; its flags say how to have it."""
    code, printed = run(train.main, "sample", *QUICK, "--nir.range", 0, 1, "--result-dir", tmp_path / "run")
    assert code == 2
    assert '--nir.range: there is no spectrum "nir".' in printed
    assert "The spectra are rgb, thermal; a configuration file defines others" in printed
    assert not (tmp_path / "run").exists()


@pytest.mark.rotating("commands that train")
def test_config_of_a_run_reproduces_it(run: Run, finished: Path, tmp_path: Path) -> None:
    """Training again from a run's config.yaml ends with the same numbers."""
    code, _ = run(train.main, "--config", finished / "config.yaml", "--result-dir", tmp_path / "again")
    assert code == 0
    first, second = (json.loads((folder / "metrics.json").read_text()) for folder in (finished, tmp_path / "again"))
    assert second["rgb"] == first["rgb"]
    assert second["thermal"] == first["thermal"]
    configs = [load_config(folder / "config.yaml") for folder in (finished, tmp_path / "again")]
    assert dataclasses.replace(configs[1], result_dir=configs[0].result_dir) == configs[0]


@pytest.mark.rotating("commands that train")
@pytest.mark.usefixtures("unharmed")
def test_run_without_its_configuration(run: Run, finished: Path, tmp_path: Path) -> None:
    """A config.yaml that somebody deleted is in the checkpoint too; without either the message says so."""
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    (folder / "config.yaml").unlink()
    assert run(train.main, "--resume", folder, "--result-dir", folder, "--max-steps", STEPS + 1)[0] == 0
    assert (folder / "config.yaml").is_file()
    shutil.rmtree(folder / "ckpts")
    (folder / "config.yaml").unlink()
    code, printed = run(train.main, "--resume", folder)
    assert code == 2
    assert "neither a config.yaml nor a checkpoint" in printed


def test_resuming_beside_a_training_suggests_no_deletion(run: Run, tmp_path: Path) -> None:
    """A run that has no checkpoint yet and is being trained is to be waited for, not to be overwritten."""
    (tmp_path / "config.yaml").write_text("data: sample\n")
    (tmp_path / LOCK_FILE).write_text("4711 elsewhere\n")
    code, printed = run(train.main, "--resume", tmp_path)
    assert code == 2
    assert "is being trained by process 4711 on elsewhere" in printed
    assert "--overwrite" not in printed


@pytest.mark.parametrize(
    "words",
    [
        ["sample", *QUICK, "--result-dir", "r" * 300],
        ["d" * 5000],
        ["--resume", "r" * 300],
    ],
)
def test_names_that_are_too_long(run: Run, words: list[str]) -> None:
    """What the file system refuses is said in a sentence that shows the beginning of the name."""
    code, printed = run(train.main, *words)
    assert code == 2
    assert "File name too long" in printed
    assert len(printed) < 700


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize("main", [train.main, export.main])
def test_edited_checkpoint(run: Run, finished: Path, tmp_path: Path, main: Callable[[list[str]], int]) -> None:
    """A checkpoint that lacks a part of the model is told, not shown as a traceback."""
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    path = folder / "ckpts" / f"step_{STEPS:06d}.pt"
    whole = torch.load(path, weights_only=True)
    for part, entries, name in (
        ("model", ("model", "gaussian_sets", "shared"), "means"),
        ("scales", ("scales",), "thermal"),
    ):
        if part == "scales" and main is train.main:
            continue  # training takes them from the capture
        state = copy.deepcopy(whole)
        reduce(dict.__getitem__, entries, state).pop(name)
        torch.save(state, path)
        code, printed = run(main, *(["--resume"] if main is train.main else []), folder)
        assert code == 2
        assert f"The checkpoint is damaged: its {part} cannot be used" in printed
