"""The table of methods by region, and where its numbers come from."""

from pathlib import Path
from typing import Any

from made_cells import made_cell
from thermosplat.method_matrix.cell_result import CellResult, write_cell, write_json
from thermosplat.method_matrix.report import write_report
from thermosplat.method_matrix.results import Results
from thermosplat.method_matrix.tables.regions import region_table
from thermosplat.method_matrix.tables.table import Table


def numbers(psnr: float, *, celsius: float | None = 0.5) -> dict[str, Any]:
    """A region's numbers."""
    depth = {"depth_error": 0.25, "depth_error_relative": 0.125, "on_own_surface": 0.5}
    return {
        "pixels": 9,
        "rgb": {"psnr": psnr, **depth},
        "thermal": {"psnr": psnr + 10, "mae_celsius": celsius, **depth},
    }


def table_of(*cells: CellResult) -> Table:
    results = Results()
    for cell in cells:
        results.add(cell, Path("made"))
    table = region_table(results)
    assert table is not None
    return table


def test_rows_are_methods_in_regions() -> None:
    """A row for each region, scene and method; the mean where a method has all scenes that have the region."""
    table = table_of(
        made_cell("desk", "3dgs", regions={"glass": numbers(20), "poster": numbers(25)}),
        made_cell("lab", "3dgs", regions={"glass": numbers(22)}),
        made_cell("lab", "mmone", regions={"glass": numbers(23, celsius=None)}),
        made_cell("arco", "mmone"),
    )
    by_row = {row[:3]: row[3:] for row in table.rows}
    assert list(by_row) == [
        ("glass", "desk", "3dgs"),
        ("glass", "lab", "3dgs"),
        ("glass", "lab", "mmone"),
        ("glass", "mean", "3dgs"),
        ("poster", "desk", "3dgs"),
    ]
    assert by_row["glass", "mean", "3dgs"] == ("21.00", "31.00", "0.500", *("0.2500", "12.50%") * 2, "50.0%", "50.0%")
    assert by_row["glass", "lab", "mmone"][2] == "-"
    assert len(table.columns) == 3 + 9


def test_seeds_and_spectra_that_were_not_modelled() -> None:
    """Several seeds give a deviation; a spectrum without a model gives dashes."""
    rgb_only = {**numbers(20), "thermal": None}
    table = table_of(
        made_cell("lab", "3dgs", 0, regions={"all": numbers(20)}),
        made_cell("lab", "3dgs", 1, regions={"all": numbers(21)}),
        made_cell("lab", "rgb", regions={"all": rgb_only}),
    )
    assert table.rows[0][3] == "20.50 ± 0.71"
    assert table.rows[1][3:] == ("20.00", "-", "-", "0.2500", "12.50%", "-", "-", "50.0%", "-")


def test_three_spectra_have_columns_of_their_own() -> None:
    """Each has its PSNR, the error of its measured values in their unit, and its depths; in the order of the cells."""
    three = numbers(20) | {"nir": {"psnr": 33.0, "mae_reflectance": 0.125, "depth_error": 0.5}}
    table = table_of(
        made_cell("lab", "3dgs", regions={"glass": numbers(20)}), made_cell("lab", "x", regions={"glass": three})
    )
    by_heading = {row[2]: dict(zip(table.columns, row, strict=True)) for row in table.rows}
    assert [heading for heading in table.columns if "PSNR" in heading] == [
        "RGB PSNR [dB]",
        "thermal PSNR [dB]",
        "NIR PSNR [dB]",
    ]
    assert by_heading["x"]["NIR PSNR [dB]"] == "33.00"
    assert by_heading["x"]["NIR MAE [reflectance]"] == "0.125"
    assert by_heading["x"]["NIR depth error"] == "0.5000"
    assert by_heading["x"]["NIR on own surface"] == "-"
    assert {by_heading["3dgs"][heading] for heading in table.columns if heading.startswith("NIR")} == {"-"}


def test_report_has_a_table_of_its_own(tmp_path: Path) -> None:
    """regions.md, .csv and .tex where a cell has regions, also such as were measured after it was finished."""
    result = made_cell()
    folder = result.cell.folder(tmp_path)
    folder.mkdir(parents=True)
    write_cell(folder, result)
    write_report(tmp_path)
    assert not list(tmp_path.glob("regions.*"))
    write_json(folder / "regions.json", {"steps": result.steps + 1, "regions": {"glass": numbers(20)}})
    write_report(tmp_path)
    assert not list(tmp_path.glob("regions.*"))  # of another checkpoint
    write_json(folder / "regions.json", {"steps": result.steps, "regions": {"glass": numbers(20)}})
    write_report(tmp_path)
    assert sorted(path.suffix for path in tmp_path.glob("regions.*")) == [".csv", ".md", ".tex"]
    assert "| glass | lab | 3dgs | 20.00 | 30.00 |" in (tmp_path / "regions.md").read_text()
    assert Results.collect(tmp_path / "elsewhere", [tmp_path]).cells[result.cell].regions == {"glass": numbers(20)}
