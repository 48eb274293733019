"""Results of cells as files."""

from pathlib import Path

import pytest
from made_cells import made_cell

from thermosplat.errors import UserError
from thermosplat.method_matrix.cell_result import FILE_NAME, read_cell, write_cell


def test_file_holds_everything(tmp_path: Path) -> None:
    """What is written comes back."""
    write_cell(tmp_path, made_cell())
    assert read_cell(tmp_path / FILE_NAME) == made_cell()


@pytest.mark.parametrize("text", ["{", "[]", '{"format": 1}', '{"format": 2}'])
def test_damaged_file_is_a_users_error(tmp_path: Path, text: str) -> None:
    """The message names the file and says how to go on."""
    (tmp_path / FILE_NAME).write_text(text)
    with pytest.raises(UserError, match=FILE_NAME) as caught:
        read_cell(tmp_path / FILE_NAME)
    assert "Delete it" in caught.value.hint
