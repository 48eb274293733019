"""Cells of one machine and of others come together."""

import csv
import json
import shutil
from pathlib import Path

import pytest

from made_cells import made_cell
from thermosplat.errors import UserError
from thermosplat.method_matrix.cell_result import CellResult, write_cell
from thermosplat.method_matrix.results import Results


def put(out: Path, *results: CellResult) -> None:
    for result in results:
        folder = result.cell.folder(out)
        folder.mkdir(parents=True)
        write_cell(folder, result)


def test_run_folders_and_results_files_merge(tmp_path: Path) -> None:
    """Another machine's run folders count, and its results.json where the folders were left behind."""
    here, there, file = tmp_path / "here", tmp_path / "there", tmp_path / "file"
    put(here, made_cell("lab", "3dgs"))
    put(there, made_cell("lab", "mmone"))
    put(file, made_cell("desk", "3dgs"))
    Results.collect(file).write(file)
    shutil.rmtree(file / "desk")
    results = Results.collect(here, [there, file])
    assert (results.scenes(), results.methods()) == (["desk", "lab"], ["3dgs", "mmone"])
    assert set(results.folders) == {made_cell("lab", "3dgs").cell, made_cell("lab", "mmone").cell}
    assert set(Results.collect(here, [file / "results.json"]).cells) == {
        made_cell("lab", "3dgs").cell,
        made_cell("desk", "3dgs").cell,
    }


def test_own_results_file_is_no_source(tmp_path: Path) -> None:
    """A cell whose folder was deleted to be made again is gone, whatever results.json still says."""
    put(tmp_path, made_cell("lab", "3dgs"), made_cell("lab", "mmone"))
    Results.collect(tmp_path).write(tmp_path)
    shutil.rmtree(tmp_path / "lab" / "mmone")
    assert Results.collect(tmp_path).methods() == ["3dgs"]


def test_cells_with_other_settings_do_not_mix(tmp_path: Path) -> None:
    """Two cells of one name that were trained differently are an error that names the difference."""
    put(tmp_path / "a", made_cell())
    put(tmp_path / "b", made_cell(settings={"max_steps": 60, "loss": {"features": 1.0}}))
    with pytest.raises(UserError, match=r"max_steps=30, now 60"):
        Results.collect(tmp_path / "a", [tmp_path / "b"])
    with pytest.raises(UserError, match=r"no .*nowhere to merge"):
        Results.collect(tmp_path / "a", [tmp_path / "nowhere"])


def test_order_of_the_paper(tmp_path: Path) -> None:
    """The paper's scenes and methods come in its order, others after them."""
    put(tmp_path, *(made_cell(scene, "thermosplat") for scene in ("zoo", "LandScape", "dimsum", "attic")))
    put(tmp_path, *(made_cell("zoo", method) for method in ("mine", "mmone", "3dgs")))
    results = Results.collect(tmp_path)
    assert results.scenes() == ["dimsum", "LandScape", "attic", "zoo"]
    assert results.methods() == ["3dgs", "mmone", "thermosplat", "mine"]


def test_results_are_written_by_cell_and_by_view(tmp_path: Path) -> None:
    """results.json has every cell, per_view.csv a row for every held-out view."""
    put(tmp_path, made_cell(seed=1), made_cell(seed=2))
    Results.collect(tmp_path).write(tmp_path)
    cells = json.loads((tmp_path / "results.json").read_text())["cells"]
    assert [cell["seed"] for cell in cells] == [1, 2]
    with (tmp_path / "per_view.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["scene"], row["seed"], row["frame"], row["spectrum"], row["lpips"]) for row in rows] == [
        ("lab", "1", "f0", "rgb", ""),
        ("lab", "2", "f0", "rgb", ""),
    ]


def test_spectra_and_their_measured_errors(tmp_path: Path) -> None:
    """In the order of the cells that have most, with the units that cells have; per_view.csv has a column per unit."""
    nir = {"psnr": 30.0, "ssim": 0.9, "lpips": None, "mae_reflectance": 0.02}
    rgb = {"psnr": 20.0, "ssim": 0.9, "lpips": None}
    thermal = rgb | {"mae_celsius": 0.5}
    views = [{"frame": "f0", "spectrum": "nir", **nir}]
    put(
        tmp_path,
        made_cell("a", "3dgs", spectra={"thermal": rgb | {"mae_celsius": None}}),
        made_cell("b", "3dgs", spectra={"rgb": rgb, "thermal": thermal, "nir": nir}, per_view=views),
        made_cell("c", "3dgs", spectra={"rgb": rgb, "nir": None, "thermal": thermal | {"mae_counts": 3.0}}),
    )
    results = Results.collect(tmp_path)
    assert results.spectra() == ["rgb", "thermal", "nir"]
    assert results.measured() == {"rgb": [], "thermal": ["mae_celsius", "mae_counts"], "nir": ["mae_reflectance"]}
    results.write(tmp_path)
    with (tmp_path / "per_view.csv").open() as file:
        rows = {row["scene"]: row for row in csv.DictReader(file)}
    assert (rows["b"]["spectrum"], rows["b"]["mae_reflectance"]) == ("nir", "0.02")
    assert rows["a"]["mae_reflectance"] == ""
    again = Results.collect(tmp_path / "elsewhere", [tmp_path / "results.json"])
    assert again.cells == results.cells
