"""Tables of the paper's shape from cells."""

import dataclasses
from pathlib import Path

from made_cells import made_cell
from thermosplat.method_matrix.cell_result import CellResult
from thermosplat.method_matrix.published_scenes import COLLECTIONS
from thermosplat.method_matrix.results import Results
from thermosplat.method_matrix.tables.paper import ablation_table, all_tables, cost_table, quality_table
from thermosplat.method_matrix.tables.paper_numbers import SCENES
from thermosplat.method_matrix.tables.table import Table


def results_of(*cells: CellResult) -> Results:
    results = Results()
    for cell in cells:
        results.add(cell, Path("made"))
    return results


def row(table: Table, *labels: str) -> tuple[str, ...]:
    """The numbers of the row that starts with these labels."""
    (found,) = [row for row in table.rows if row[: len(labels)] == labels]
    return found[len(labels) :]


def test_methods_on_scenes() -> None:
    """A row for each spectrum, metric and method; the mean where a method has all scenes."""
    table = quality_table(results_of(made_cell("lab", "3dgs"), made_cell("desk", "3dgs"), made_cell("lab", "mmone")))
    assert table.columns == ("spectrum", "metric", "method", "desk", "lab", "mean")
    assert row(table, "rgb", "PSNR", "3dgs") == ("24.42", "24.42", "24.42")
    assert row(table, "rgb", "PSNR", "mmone") == ("-", "25.42", "-")
    assert row(table, "thermal", "MAE [°C]", "3dgs") == ("0.250", "0.250", "0.250")
    assert not [line for line in table.rows if line[1] == "LPIPS"]
    assert "paper" not in table.title


def test_seeds_give_a_mean_and_a_deviation() -> None:
    """Several seeds: mean ± standard deviation, of a scene and of the mean over scenes."""
    cells = [made_cell(scene, "3dgs", seed) for scene in ("lab", "desk") for seed in (0, 100)]
    assert row(quality_table(results_of(*cells)), "rgb", "PSNR", "3dgs") == ("24.50 ± 0.71",) * 3


def test_paper_numbers_stand_beside_ours() -> None:
    """On a scene of the paper its PSNR follows ours; its means only where all ten scenes are there."""
    one = quality_table(results_of(made_cell("Truck", "thermosplat"), made_cell("lab", "thermosplat")))
    assert row(one, "rgb", "PSNR", "thermosplat (paper)") == ("24.31", "-", "-")
    assert "(paper)" in one.title
    ten = quality_table(results_of(*(made_cell(scene, "3dgs") for scene in SCENES)))
    assert row(ten, "thermal", "SSIM", "3dgs (paper)")[-1] == "0.861"


def test_thermonerf_stands_beside_its_own_ten_scenes() -> None:
    """Its mean error in degrees, and only where the scenes are all of its own."""
    scenes = list(COLLECTIONS["thermoscenes"].scenes)
    ten = quality_table(results_of(*(made_cell(scene, "3dgs") for scene in scenes)))
    assert row(ten, "thermal", "MAE [°C]", "thermonerf (paper)") == (*["-"] * 10, "1.500")
    nine = quality_table(results_of(*(made_cell(scene, "3dgs") for scene in scenes[1:])))
    assert "thermonerf (paper)" not in {line[2] for line in nine.rows}


def test_ablations_have_a_table_of_their_own() -> None:
    """Ablations beside the full method; they are left out of the first table."""
    cells = [made_cell(scene, method) for scene in SCENES for method in ("thermosplat", "no_hybrid_rgb")]
    tables = {table.name: table for table in all_tables(results_of(*cells))}
    assert list(tables) == ["table1", "table2", "cost"]
    assert {line[2] for line in tables["table1"].rows} == {"thermosplat", "thermosplat (paper)"}
    assert row(tables["table2"], "no_hybrid_rgb") == ("33.42", "0.900", "-", "34.42", "0.950", "-")
    assert row(tables["table2"], "no_hybrid_rgb (paper)")[:2] == ("25.07", "0.867")
    assert "10 scenes" in tables["table2"].title


def three_spectra(scene: str, method: str) -> CellResult:
    """A cell with near infrared beside the spectra of the paper."""
    made = made_cell(scene, method)
    nir = {"psnr": 30.0, "ssim": 0.97, "lpips": None, "mae_reflectance": 0.025}
    return dataclasses.replace(made, spectra=made.spectra | {"nir": nir})


def test_three_spectra_in_all_tables() -> None:
    """Rows and columns of each; errors in its own unit; the paper's numbers beside those that it has."""
    cells = [three_spectra(scene, method) for scene in SCENES for method in ("thermosplat", "no_hybrid_rgb")]
    tables = {table.name: table for table in all_tables(results_of(*cells))}
    first, second = tables["table1"], tables["table2"]
    assert list(dict.fromkeys(line[0] for line in first.rows)) == ["rgb", "thermal", "nir"]
    assert row(first, "nir", "PSNR", "thermosplat") == ("30.00",) * 11
    assert row(first, "nir", "MAE [reflectance]", "thermosplat") == ("0.025",) * 11
    assert [line[1] for line in first.rows if line[0] == "thermal" and line[2] == "thermosplat"] == [
        "PSNR",
        "SSIM",
        "MAE [°C]",
    ]
    assert not [line for line in first.rows if line[0] == "nir" and "(paper)" in line[2]]
    assert row(first, "rgb", "PSNR", "thermosplat (paper)")[-1] == "25.23"
    assert second.columns[-3:] == ("nir PSNR", "nir SSIM", "nir LPIPS")
    assert row(second, "no_hybrid_rgb")[-3:] == ("30.00", "0.970", "-")
    assert row(second, "no_hybrid_rgb (paper)") == ("25.07", "0.867", "0.157", "25.86", "0.893", "0.105", "-", "-", "-")


def test_methods_of_other_spectra_share_a_table() -> None:
    """A method that lacks a spectrum has no row of it, and scenes without it have a dash."""
    table = quality_table(
        results_of(made_cell("lab", "mmone"), three_spectra("lab", "3dgs"), made_cell("desk", "3dgs"))
    )
    assert row(table, "nir", "PSNR", "3dgs") == ("-", "30.00", "-")
    assert not [line for line in table.rows if line[0] == "nir" and line[2] == "mmone"]


def test_incomplete_ablation_has_no_mean() -> None:
    """A mean over other scenes than the others' would mislead."""
    results = results_of(made_cell("a", "thermosplat"), made_cell("b", "thermosplat"), made_cell("a", "mlp_based"))
    assert set(row(ablation_table(results, ["mlp_based"]), "mlp_based")) == {"-"}


def test_cost_table() -> None:
    """Gaussians, megabytes, minutes, memory and frames a second; a dash for what was not measured."""
    table = cost_table(results_of(made_cell(peak_memory_bytes=None)))
    assert row(table, "lab", "3dgs") == ("30", "1,234", "2.5", "1.5", "-", "100.0", "a device")
