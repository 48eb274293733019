"""Results of cells as files."""

import dataclasses
from pathlib import Path

import pytest

from made_cells import made_cell
from thermosplat.errors import UserError
from thermosplat.method_matrix.cell_result import FILE_NAME, read_cell, write_cell


def test_file_holds_everything(tmp_path: Path) -> None:
    """What is written comes back."""
    write_cell(tmp_path, made_cell())
    assert read_cell(tmp_path / FILE_NAME) == made_cell()


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
