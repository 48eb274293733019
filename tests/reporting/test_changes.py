"""The chapter on changes, from the folder of a comparison."""

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from thermosplat.errors import UserError
from thermosplat.pictures.image_display import write_png
from thermosplat.reporting.blocks import Heading, Paragraph, Picture, Table
from thermosplat.reporting.changes import changes_since
from thermosplat.reporting.texts import Words
from thermosplat.thermography.comparison_file import change_picture, plan_picture, read_comparison

KINDS = ("warmer", "moved")


def comparison(folder: Path, **changed: Any) -> Path:
    """A comparison of two runs with two changes."""
    numbers = {"east": 3.0, "north": -2.5, "area": 12.4, "difference": 1.5, "plus_minus": 0.25, "height": 0.0}
    date = {"name": "june", "run": str(folder / "june"), "shift": 2.0, "shift_plus_minus": 0.5, "span": 3.0}
    date |= {"to_first": np.eye(4)[:3].tolist()}
    date |= {"changes": [{"number": number, "kind": kind, **numbers} for number, kind in enumerate(KINDS, 1)]}
    content = {"format": "thermosplat-comparison", "version": 1, "first": "march", "run": str(folder / "march")}
    content |= {"spectrum": "thermal", "unit": "celsius", "length_unit": "m", "dates": [{**date, **changed}]}
    (folder / "changes.json").write_text(json.dumps(content))
    for name in (plan_picture(1), *(change_picture(1, number) for number in (1, 2))):
        write_png(folder / name, np.full((4, 6, 3), 200, np.uint8))
    return folder


@pytest.mark.parametrize(
    ("language", "kinds", "said"),
    [("en", ["1 warmer", "2 moved"], "+2.00 ± 0.50 K"), ("de", ["1 wärmer", "2 bewegt"], "+2,00 ± 0,50 K")],
)
def test_the_changes_of_a_run(tmp_path: Path, language: Literal["en", "de"], kinds: list[str], said: str) -> None:
    """The shift, a plan, a row for each change and a picture of both dates, in the report's language."""
    known = read_comparison(comparison(tmp_path))
    blocks = list(changes_since(known, known.of(tmp_path / "june"), Words(language)))
    assert "march" in next(block.text for block in blocks if isinstance(block, Heading))
    assert said in next(block.text for block in blocks if isinstance(block, Paragraph))
    (table,) = (block for block in blocks if isinstance(block, Table))
    assert [row[0] for row in table.rows] == kinds
    pictures = [block for block in blocks if isinstance(block, Picture)]
    assert len(pictures) == 3
    assert pictures[0].image.shape == (4, 6, 3)


def test_nothing_changed(tmp_path: Path) -> None:
    """That is said, without a table."""
    known = read_comparison(comparison(tmp_path, changes=[]))
    blocks = list(changes_since(known, known.dates[0], Words("en")))
    assert not any(isinstance(block, Table | Picture) for block in blocks)


@pytest.mark.parametrize(
    "wrong",
    [{"shift": float("nan")}, {"to_first": [[1]]}, {"changes": [{"kind": "<b>"}]}, {"changes": 3}, {"run": "march"}],
)
def test_a_comparison_that_is_damaged_or_of_other_runs(tmp_path: Path, wrong: dict[str, Any]) -> None:
    """It is refused in a sentence."""
    with pytest.raises(UserError, match=r"that can be read|none of the later ones"):
        read_comparison(comparison(tmp_path, **wrong)).of(tmp_path / "june")


def test_a_folder_without_its_pictures(tmp_path: Path) -> None:
    """The picture is named."""
    known = read_comparison(comparison(tmp_path))
    (tmp_path / plan_picture(1)).unlink()
    with pytest.raises(UserError, match=r"difference_1\.png is no picture"):
        list(changes_since(known, known.dates[0], Words("en")))
