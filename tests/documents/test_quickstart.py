"""The quickstart notebook: what is stored was executed, and it still runs."""

import json
import re
from pathlib import Path

import pytest

from repository_documents import REPOSITORY

NOTEBOOK = REPOSITORY / "docs" / "quickstart.ipynb"


def printed(cells: list[dict]) -> str:
    """All that the code cells printed and displayed as text."""
    outputs = [output for cell in cells for output in cell.get("outputs", ())]
    texts = [output.get("text") or output.get("data", {}).get("text/plain", "") for output in outputs]
    return "\n".join("".join(text) for text in texts)


def test_the_stored_notebook_was_executed() -> None:
    """Every code cell has run, in order, without an error; no path of a machine is in it."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    kinds = {output["output_type"] for cell in code for output in cell["outputs"]}
    assert "error" not in kinds
    assert sum("image/png" in output.get("data", {}) for cell in code for output in cell["outputs"]) == 2
    assert re.search(r"[\d.]+ °C rendered, [\d.]+ °C measured", printed(code))
    assert not re.search(r"(?<![\w~.])/(?:home|root|tmp|work|Users)/", NOTEBOOK.read_text(encoding="utf-8"))


def test_links_of_the_notebook_lead_somewhere() -> None:
    """Pages beside it are there."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    text = "".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    links = re.findall(r"\]\(([^)]+\.md)\)", text)
    assert links
    for link in links:
        assert (NOTEBOOK.parent / link).is_file()


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path) -> None:
    """From the capture to the exported file, in a kernel of its own; the temperature lies in the sample's range."""
    nbformat = pytest.importorskip("nbformat", reason='nbformat is not installed (pip install ".[test]")')
    nbclient = pytest.importorskip("nbclient", reason='nbclient is not installed (pip install ".[test]")')
    pytest.importorskip("ipykernel", reason='ipykernel is not installed (pip install ".[test]")')
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    where = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=500, kernel_name="python3", resources=where).execute()
    text = printed(notebook.cells)
    rendered, measured = map(float, re.search(r"([\d.]+) °C rendered, ([\d.]+) °C measured", text).groups())
    assert 15 < rendered < 60
    assert 15 < measured < 60
    before, after = map(float, re.search(r"([\d.]+) dB .* before the fit, ([\d.]+) dB after", text).groups())
    assert after > before
    exports = tmp_path / "results" / "quickstart" / "exports"
    assert [path.name for path in exports.iterdir()] == ["splat_rgb.spz"]
    assert (exports.parent / "index.html").is_file()
