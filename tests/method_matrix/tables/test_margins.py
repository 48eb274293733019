"""Margins over the best other method."""

from pathlib import Path

import pytest

from made_cells import made_cell
from thermosplat.method_matrix.results import Results
from thermosplat.method_matrix.tables.margins import Duel, margin, margins_table
from thermosplat.method_matrix.tables.table import Table


def results_of(scores: dict[tuple[str, str], tuple[float, float]]) -> Results:
    """Cells with given PSNR of RGB and thermal, by scene and method; LPIPS falls with RGB's PSNR."""
    results = Results()
    for (scene, method), (rgb, thermal) in scores.items():
        made = made_cell(
            scene,
            method,
            spectra={
                "rgb": {"psnr": rgb, "ssim": 0.9, "lpips": 1.0 - rgb / 100},
                "thermal": {"psnr": thermal, "ssim": 0.9, "lpips": None, "mae_celsius": 30.0 - thermal},
            },
        )
        results.add(made, Path("made"))
    return results


def results_of_spectra(scores: dict[str, dict[str, float]]) -> Results:
    """Cells of one scene with given PSNR, by method and spectrum; errors of measured values fall with it."""
    results = Results()
    for method, psnrs in scores.items():
        numbers = {
            name: {"psnr": psnr, "ssim": 0.9, "lpips": None, "mae_reflectance": 1.0 - psnr / 100}
            for name, psnr in psnrs.items()
        }
        results.add(made_cell("a", method, spectra=numbers), Path("made"))
    return results


def row(table: Table, *labels: str) -> tuple[str, ...]:
    (found,) = [row for row in table.rows if row[:4] == labels]
    return found[4:]


SCORES = {
    ("a", "thermosplat"): (25.0, 26.0),
    ("a", "mmone"): (24.0, 26.5),
    ("a", "3dgs"): (24.5, 24.0),
    ("b", "thermosplat"): (21.0, 20.0),
    ("b", "mmone"): (20.0, 19.0),
    ("b", "3dgs"): (19.0, 19.5),
}


def test_margin_over_the_best_baseline() -> None:
    """In every column over whichever is best there; the mean's rival is the best on the mean."""
    table = margins_table(results_of(SCORES))
    assert table.columns[4:] == ("a", "b", "mean", "best rival", "paper")
    assert row(table, "rgb", "PSNR", "thermosplat", "best baseline") == ("+0.50", "+1.00", "+1.00", "mmone", "+0.34")
    assert row(table, "thermal", "PSNR", "thermosplat", "best baseline")[:3] == ("-0.50", "+0.50", "+0.25")
    assert row(table, "all", "PSNR", "thermosplat", "best baseline")[:3] == ("+0.25", "+1.00", "+0.62")


def test_less_is_better_for_lpips_and_degrees() -> None:
    """A positive margin is better in every metric, as in the paper's, which has MS-Splatting second in LPIPS."""
    table = margins_table(results_of(SCORES))
    assert row(table, "rgb", "LPIPS", "thermosplat", "best baseline")[::4] == ("+0.005", "+0.015")
    assert row(table, "thermal", "MAE [°C]", "thermosplat", "best baseline")[0] == "-0.500"


def test_methods_beyond_the_paper_and_ablations() -> None:
    """Another method of ours is compared with baselines and with the full method, the full one with its ablations."""
    scores = SCORES | {(scene, "mine"): (26.0, 27.0) for scene in "ab"} | {(s, "mlp_based"): (20.0, 19.0) for s in "ab"}
    table = margins_table(results_of(scores))
    assert row(table, "rgb", "PSNR", "mine", "thermosplat") == ("+1.00", "+5.00", "+3.00", "-", "-")
    assert row(table, "rgb", "PSNR", "mine", "best baseline")[3] == "mmone"
    assert row(table, "rgb", "PSNR", "thermosplat", "mlp_based") == ("+5.00", "+1.00", "+3.00", "-", "+0.09")
    assert not [line for line in table.rows if line[2] in ("mmone", "mlp_based")]


def test_missing_numbers_have_no_margin() -> None:
    """A baseline without a scene is out of the mean; nobody to compare with leaves no table."""
    scores = {key: value for key, value in SCORES.items() if key != ("b", "mmone")}
    assert row(margins_table(results_of(scores)), "rgb", "PSNR", "thermosplat", "best baseline")[2] == "+1.25"
    assert not margins_table(results_of({("a", "thermosplat"): (25.0, 26.0)})).rows
    duel = Duel("x", "y", ["y"])
    assert margin({"x": None, "y": 1.0}, duel, "psnr") is None
    assert margin({"x": 1.0, "y": None}, duel, "psnr") is None


def test_paper_is_ahead_by_what_it_says() -> None:
    """+0.34 dB RGB and +0.19 dB thermal over the second best method, which is the same one in both."""
    table = margins_table(results_of(SCORES))
    paper = [row(table, m, "PSNR", "thermosplat", "best baseline")[-1] for m in ("rgb", "thermal", "all")]
    assert [float(text) for text in paper] == pytest.approx([0.34, 0.19, 0.27], abs=0.006)


def test_three_spectra() -> None:
    """Rows of each, with its own errors; "all" is their mean, of methods that have all; the paper knows two alone."""
    table = margins_table(
        results_of_spectra(
            {
                "thermosplat": {"rgb": 25.0, "thermal": 26.0, "nir": 30.0},
                "mmone": {"rgb": 24.0, "thermal": 26.0, "nir": 28.0},
                "3dgs": {"rgb": 24.5, "thermal": 27.0},
            }
        )
    )
    assert list(dict.fromkeys(line[0] for line in table.rows)) == ["rgb", "thermal", "nir", "all"]
    assert row(table, "rgb", "PSNR", "thermosplat", "best baseline") == ("+0.50", "+0.50", "3dgs", "+0.34")
    assert row(table, "nir", "PSNR", "thermosplat", "best baseline") == ("+2.00", "+2.00", "mmone", "-")
    assert row(table, "nir", "MAE [reflectance]", "thermosplat", "best baseline")[0] == "+0.020"
    assert row(table, "all", "PSNR", "thermosplat", "best baseline") == ("+1.00", "+1.00", "mmone", "-")


def test_one_spectrum_has_no_mean_of_all() -> None:
    """The rows would say the same twice."""
    table = margins_table(results_of_spectra({"thermosplat": {"rgb": 25.0}, "mmone": {"rgb": 24.0}}))
    assert {line[0] for line in table.rows} == {"rgb"}
    assert row(table, "rgb", "PSNR", "thermosplat", "best baseline") == ("+1.00", "+1.00", "mmone", "+0.34")
