"""One cell, from its configuration to its cell.json."""

import dataclasses
from pathlib import Path

import pytest

from multispectral_capture import near_infrared, write_multispectral_capture
from thermosplat.config import TrainConfig
from thermosplat.method_matrix.cell_result import FILE_NAME, read_cell
from thermosplat.method_matrix.cell_run import make_cell
from thermosplat.method_matrix.cells import Cell, Scene, cell_config
from thermosplat.method_matrix.panels import read_panels
from thermosplat.training.session.interruption import TrainingInterrupted
from thermosplat.training.trainer import Trainer

CELL = Cell("sample", "mmone", 42)


def quick_config(steps: int = 4) -> TrainConfig:
    return cell_config(
        "mmone", Scene("sample", "sample"), 42, max_steps=steps, data_factor=4, device="cpu", sh_degree_interval=1000
    )


def test_finished_cell_says_everything(tmp_path: Path) -> None:
    """Quality, cost, per-view numbers and pictures; the file is what was returned; checkpoints as asked for."""
    result = make_cell(CELL, quick_config(), tmp_path, keep_checkpoint=False)
    assert read_cell(tmp_path / FILE_NAME) == result
    assert result.cell == CELL
    assert list(result.spectra) == ["rgb", "thermal"]
    rgb, thermal = result.spectra.values()
    assert rgb is not None
    assert thermal is not None
    assert rgb["psnr"] > 5
    assert thermal["mae_celsius"] > 0
    # the run is too short for spherical harmonics above degree 0: they are zero, and stored as a byte a set
    assert result.model_bytes == result.num_gaussians * (4 * (3 + 4 + 3 + 1 + 1 + 2 * 3) + 2)
    assert result.frames_per_second > 0
    assert result.peak_memory_bytes is None
    by_view = [row["psnr"] for row in result.per_view if row["spectrum"] == "rgb"]
    assert sum(by_view) / len(by_view) == pytest.approx(rgb["psnr"])
    assert len(read_panels(tmp_path)) == 6
    assert not list((tmp_path / "ckpts").iterdir())


def test_cell_of_three_spectra(tmp_path: Path) -> None:
    """A third spectrum is read, trained and measured like the others, and has its pictures."""
    root = write_multispectral_capture(tmp_path / "desk", {"nir": near_infrared}, thermal=True, depth=16)
    preset = tmp_path / "three.yaml"
    preset.write_text(
        f"base: thermalgaussian_ommg\nspectra:\n  nir: {{unit: reflectance, factor: {1 / 65535}, opacity: own}}\n"
    )
    config = cell_config(str(preset), Scene("desk", str(root)), 42, max_steps=2, data_factor=4, device="cpu")
    result = make_cell(Cell("desk", "three", 42), config, tmp_path / "cell", keep_checkpoint=False)
    assert read_cell(tmp_path / "cell" / FILE_NAME) == result
    assert list(result.spectra) == ["rgb", "thermal", "nir"]
    assert result.spectra["nir"] is not None
    assert 0 < result.spectra["nir"]["mae_reflectance"] < 1
    assert {row["spectrum"] for row in result.per_view} == {"rgb", "thermal", "nir"}
    nir = [row["mae_reflectance"] for row in result.per_view if row["spectrum"] == "nir"]
    assert sum(nir) / len(nir) == pytest.approx(result.spectra["nir"]["mae_reflectance"])
    assert {spectrum for _, spectrum in read_panels(tmp_path / "cell")} == {"rgb", "thermal", "nir"}


def test_interrupted_cell_is_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After Ctrl-C the same call does the rest only; another configuration starts again."""
    whole_step = Trainer.train_step
    done: list[int] = []

    def step(trainer: Trainer) -> None:
        if trainer.step == 2 and done == [0, 1]:
            done.clear()
            raise KeyboardInterrupt
        done.append(trainer.step)
        whole_step(trainer)

    monkeypatch.setattr(Trainer, "train_step", step)
    with pytest.raises(TrainingInterrupted):
        make_cell(CELL, quick_config(), tmp_path, keep_checkpoint=True)
    assert not (tmp_path / FILE_NAME).exists()
    assert make_cell(CELL, quick_config(), tmp_path, keep_checkpoint=True).steps == 4
    assert done == [2, 3]
    assert [path.name for path in (tmp_path / "ckpts").iterdir()] == ["step_000004.pt"]
    done.clear()
    make_cell(CELL, dataclasses.replace(quick_config(2), seed=1), tmp_path, keep_checkpoint=True)
    assert done == [0, 1]
