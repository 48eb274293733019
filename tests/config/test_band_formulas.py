"""Formulas of bands are data: arithmetic of bands and numbers, and nothing that could run."""

import pytest

from thermosplat.config.band_formulas import parsed
from thermosplat.errors import UserError


@pytest.mark.parametrize(
    ("formula", "value"),
    [("(b2 - b1) / (b2 + b1)", 0.5), ("-b1 * 2.5 + 4", 1.5), ("b1", 1.0), ("2 - 3 - 4", -5.0), ("2 * (b1 + b2)", 8.0)],
)
def test_arithmetic(formula: str, value: float) -> None:
    """Signs bind as everywhere."""
    bands = [1.0, 3.0]
    assert parsed(f"x={formula}", 2, "derived").value(bands.__getitem__) == value


@pytest.mark.parametrize(
    "formula",
    [
        *(
            "__import__('os')",
            "b1.real",
            "b1 ** 9",
            "b1 if b2 else b1",
            "[b1]",
            "lambda: b1",
            "b1 @ b2",
            "'b1'",
            "True",
        ),
        *("b1 and b2", "b1 < b2", "(b1 := b2)", "f'{b1}'", "1j", "b1 // b2", "~b1", "+b1", "open", "...", "b1; b2"),
        *("b0", "b3", "b01", "B1", "b", "", "b1 +", "(" * 300, "-" * 499 + "b1", "+".join(["b1"] * 300)),
    ],
)
def test_what_is_no_arithmetic_is_refused(formula: str) -> None:
    """Calls, attributes, comparisons, bands that do not exist, and what is too long or deep."""
    with pytest.raises(UserError, match=r"^--nir\.derived"):
        parsed(f"x = {formula}", 2, "--nir.derived").value([1.0, 3.0].__getitem__)


@pytest.mark.parametrize("text", ["b1", "X = b1", "x y = b1", "= b1", "import os = b1", "1 = b1"])
def test_a_formula_has_a_name(text: str) -> None:
    """Small letters, digits and underscores."""
    with pytest.raises(UserError, match="must be a name in small letters"):
        parsed(text, 2, "--nir.derived")
