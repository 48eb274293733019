"""Margins view by view."""

from pathlib import Path

from made_cells import made_cell
from thermosplat.method_matrix.results import Results
from thermosplat.method_matrix.tables.paired import paired_table


def results_of(scores: dict[tuple[str, str, int], dict[str, float]], spectrum: str = "rgb") -> Results:
    """Cells with given PSNR of a spectrum's views, by scene, method and seed."""
    results = Results()
    for (scene, method, seed), views in scores.items():
        per_view = [{"frame": frame, "spectrum": spectrum, "psnr": psnr} for frame, psnr in views.items()]
        made = made_cell(scene, method, seed, per_view=per_view, spectra={"rgb": None, spectrum: None})
        results.add(made, Path("made"))
    return results


def test_mean_and_standard_error_of_the_differences() -> None:
    """Differences 1, 2 and 3 have the mean 2 and the standard deviation 1; a view that one lacks does not count."""
    table = paired_table(
        results_of(
            {
                ("a", "thermosplat", 42): {"f0": 21.0, "f1": 32.0, "f2": 13.0, "f3": 50.0},
                ("a", "mlp_based", 42): {"f0": 20.0, "f1": 30.0, "f2": 10.0},
                ("b", "thermosplat", 42): {"f0": 20.0},
                ("b", "mlp_based", 42): {"f0": 20.5},
            }
        )
    )
    assert table.columns == ("spectrum", "method", "over", "a", "b")
    assert table.rows == (("rgb", "thermosplat", "mlp_based", "+2.00 ± 0.58 (3)", "-0.50 (1)"),)


def test_seeds_are_paired_with_themselves() -> None:
    """The same view of two seeds is two pairs."""
    cells = {
        ("a", method, seed): {"f0": 20.0 + seed + ahead}
        for method, ahead in (("thermosplat_plus", 1.0), ("thermosplat", 0.0))
        for seed in (1, 2)
    }
    assert paired_table(results_of(cells)).rows == (("rgb", "thermosplat_plus", "thermosplat", "+1.00 ± 0.00 (2)"),)


def test_views_of_any_spectrum() -> None:
    """A third spectrum's views are paired like the others'."""
    cells = {("a", "thermosplat", 42): {"f0": 21.0, "f1": 23.0}, ("a", "mlp_based", 42): {"f0": 20.0, "f1": 22.0}}
    table = paired_table(results_of(cells, "nir"))
    assert table.rows == (("nir", "thermosplat", "mlp_based", "+1.00 ± 0.00 (2)"),)


def test_baselines_are_not_listed() -> None:
    """The best of several changes from scene to scene, which makes no pairs."""
    cells = {("a", method, 42): {"f0": 20.0} for method in ("thermosplat", "3dgs", "mmone")}
    assert paired_table(results_of(cells)).rows == ()
