"""Tables and plots of the budget benchmark have all spectra that were measured."""

from pathlib import Path
from typing import Any

import pytest

from bench_budget import measured_spectra, plot, table


def row(budget: float, **psnrs: float | None) -> dict[str, Any]:
    """A measurement with given PSNR by spectrum."""
    found = {"budget": budget, "num_gaussians": int(1000 * budget), "model_bytes": int(9000 * budget), "ms": 2.0}
    return found | {f"{name}_psnr": value for name, value in psnrs.items()}


def test_table_has_a_column_per_spectrum() -> None:
    """In the order in which they are met; what a row lacks is a dash; rows of version 0.1 are like today's."""
    rows = [row(1.0, rgb=25.0, thermal=26.0, nir=30.0), row(0.1, rgb=24.5, thermal=None)]
    assert measured_spectra(rows) == ["rgb", "thermal", "nir"]
    lines = table(rows).splitlines()
    assert lines[0].endswith("| bytes_share | rgb_psnr | thermal_psnr | nir_psnr | ms |")
    assert lines[2] == "| 10% | 100 | 900 | 10.0% | 24.50 | - | - | 2.00 |"
    assert lines[3] == "| 100% | 1,000 | 9,000 | 100.0% | 25.00 | 26.00 | 30.00 | 2.00 |"


@pytest.mark.parametrize("spectra", [("rgb",), ("rgb", "thermal", "nir")])
def test_plot_has_a_row_per_spectrum(tmp_path: Path, spectra: tuple[str, ...]) -> None:
    """One spectrum or several; a scene without one is left out of its row."""
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    rows = [row(budget, **{name: 20.0 + budget for name in spectra}) for budget in (0.1, 1.0)]
    other = [row(budget, rgb=20.0 + budget) for budget in (0.1, 1.0)]
    assert plot({"lab": rows, "desk": other}, tmp_path / "budget.png")
    assert (tmp_path / "budget.png").stat().st_size > 10_000
