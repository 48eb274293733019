"""Results of cells as files."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from made_cells import made_cell
from thermosplat.errors import UserError
from thermosplat.method_matrix.cell_result import FILE_NAME, read_cell, write_cell
from thermosplat.method_matrix.cells import Scene
from thermosplat.method_matrix.matrix import Matrix
from thermosplat.method_matrix.results import Results


def test_file_holds_everything(tmp_path: Path) -> None:
    """What is written comes back."""
    write_cell(tmp_path, made_cell())
    assert read_cell(tmp_path / FILE_NAME) == made_cell()


OLD: dict[str, Any] = {
    "format": 1,
    "scene": "lab",
    "method": "mmone",
    "seed": 42,
    "steps": 300,
    "rgb": {"psnr": 20.0, "ssim": 0.9, "lpips": None},
    "thermal": {"psnr": 21.0, "ssim": 0.95, "lpips": None, "mae_celsius": 0.25},
    "num_gaussians": 1234,
    "model_bytes": 2_500_000,
    "train_minutes": 1.5,
    "peak_memory_bytes": None,
    "frames_per_second": 100.0,
    "device": "a device",
    "lpips_net": None,
    "settings": {"max_steps": 300, "loss": {"thermal": 0.7}, "model": {"thermal_opacity": "own", "rgb": True}},
    "per_view": [
        {"frame": "f0", "modality": "rgb", "psnr": 20.0, "ssim": 0.9, "lpips": None, "mae_celsius": None},
        {"frame": "f0", "modality": "thermal", "psnr": 21.0, "ssim": 0.95, "lpips": None, "mae_celsius": 0.25},
    ],
    "regions": None,
}
"""A cell.json of version 0.1."""


def test_cells_of_the_first_format_are_read(tmp_path: Path) -> None:
    """Metrics and views go by spectrum, and settings by today's names; what 0.1 could not set has its default."""
    (tmp_path / FILE_NAME).write_text(json.dumps(OLD))
    result = read_cell(tmp_path / FILE_NAME)
    assert result.spectra == {"rgb": OLD["rgb"], "thermal": OLD["thermal"]}
    assert [(row["frame"], row["spectrum"], row["psnr"]) for row in result.per_view] == [
        ("f0", "rgb", 20.0),
        ("f0", "thermal", 21.0),
    ]
    assert not any("modality" in row for row in result.per_view)
    thermal = result.settings["spectra"]["thermal"]
    assert (thermal["loss"], thermal["opacity"], thermal["smoothness"]) == (0.7, "own", 0.3)
    assert result.settings["max_steps"] == 300
    assert result.settings["without"] == []
    assert not {"thermal_opacity", "rgb"} & result.settings["model"].keys()
    write_cell(tmp_path, result)
    assert json.loads((tmp_path / FILE_NAME).read_text())["format"] == 2
    assert read_cell(tmp_path / FILE_NAME) == result


def test_a_cell_of_the_first_format_without_thermal(tmp_path: Path) -> None:
    """A spectrum that was not modelled is not among the metrics."""
    (tmp_path / FILE_NAME).write_text(json.dumps(OLD | {"thermal": None, "settings": {"model": {"thermal": False}}}))
    result = read_cell(tmp_path / FILE_NAME)
    assert list(result.spectra) == ["rgb"]
    assert result.settings["without"] == ["thermal"]


def test_a_matrix_of_the_first_version_can_be_gone_on_with(tmp_path: Path) -> None:
    """What 0.1 wrote of MMOne is what today's preset asks for, though settings have other names and there are more."""
    then = {
        "max_steps": 300,
        "seed": 42,
        "thermal": {"source": "auto", "unit": "auto", "range_celsius": None, "palette": None, "aligned": False},
        "model": {
            "rgb": True,
            "thermal": True,
            "feature_dim": 0,
            "geometric_decoupling": True,
            "thermal_opacity": "own",
            "thermal_start": "points",
        },
        "decoder": {"hybrid_rgb": True, "rgb_head_bias": -4.0},
        "schedule": {"thermal_from": 0.0, "rgb_until": 1.0},
        "loss": {"rgb": 0.5, "thermal": 0.5, "features": 0.0, "features_thermal": 0.5, "thermal_smoothness": 0.3},
        "optimizer": {"thermal_sh0_lr": 0.0025, "thermal_shN_lr": 0.000125, "thermal_opacities_lr": 0.05},
        "densification": {"strategy": "default", "grad_threshold": 0.0002, "decompose_threshold": 0.0002},
    }
    path = tmp_path / "lab" / "mmone" / "seed_42" / FILE_NAME
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(OLD | {"settings": then}))
    matrix = Matrix(tmp_path, [Scene("lab", "lab")], {"mmone": "mmone"}, max_steps=300)
    assert matrix.missing(Results.collect(tmp_path).cells) == []
    path.write_text(json.dumps(OLD | {"settings": then | {"loss": {"rgb": 0.25, "features": 0.0}}}))
    with pytest.raises(UserError, match=r"is finished with spectra.rgb.loss=0.25, now 0.5"):
        matrix.missing(Results.collect(tmp_path).cells)


def test_a_cell_with_a_setting_that_is_gone(tmp_path: Path) -> None:
    """It counts as made today where it asked for what is done today, else as another one, which is to be made again."""
    write_cell(tmp_path, dataclasses.replace(made_cell(), settings={"auto_budget": {"prune_change": 0.02}}))
    assert read_cell(tmp_path / FILE_NAME).settings == {}
    write_cell(tmp_path, dataclasses.replace(made_cell(), settings={"auto_budget": {"prune_change": 0.03}}))
    with pytest.raises(UserError, match=r"prune_change is no setting any more, found 0\.03") as caught:
        read_cell(tmp_path / FILE_NAME)
    assert "makes the cell again" in caught.value.hint


@pytest.mark.parametrize("text", ["{", "[]", '{"format": 1}', '{"format": 2}', '{"format": 3}'])
def test_damaged_file_is_a_users_error(tmp_path: Path, text: str) -> None:
    """The message names the file and says how to go on."""
    (tmp_path / FILE_NAME).write_text(text)
    with pytest.raises(UserError, match=FILE_NAME) as caught:
        read_cell(tmp_path / FILE_NAME)
    assert "Delete it" in caught.value.hint
