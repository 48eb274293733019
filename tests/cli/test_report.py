"""thermosplat-report: the run's report as HTML and PDF, and report.yaml that people fill in."""

import json
import re
import shutil
from importlib.resources import files
from pathlib import Path

import pytest

from sample_runs import QUICK, Run
from thermosplat.cli import report, train
from thermosplat.reporting.findings_file import read_findings


@pytest.mark.slow
def test_report_of_a_run(run: Run, finished: Path, tmp_path: Path) -> None:
    """First page, findings, form; what report.yaml says is in the next report, and stays as it is."""
    folder = tmp_path / "a <b> run"
    shutil.copytree(finished, folder)
    code, printed = run(report.main, folder, "--device", "cpu", "--delta", 0.05)  # of a scene of three steps
    assert code == 0, printed
    page = (folder / "report" / "report.html").read_text()
    assert "Thermography report" in page
    assert "°C" in page
    assert "not given" in page
    assert "intensities without a unit" not in page
    assert "ΔT to the reference" in page
    assert 1 < page.count("data:image/png") < 40
    pdf = (folder / "report" / "report.pdf").read_bytes()
    assert pdf.startswith(b"%PDF")
    assert len(re.findall(rb"/Type /Page\b", pdf)) > page.count('class="new-page"')  # a long table goes on
    written = json.loads((folder / "report" / "findings.json").read_text())
    listed, things = written["findings"], written["things"]
    assert len(listed) == page.count("<h3")
    assert bool(things) == ("Things that have nothing like them" in page)
    assert [one.place for one in read_findings(folder)] == [tuple(one["place"]) for one in listed]
    said = folder / "report.yaml"
    text = said.read_text().replace('client: ""', 'client: "Müller <b>& Co</b>"  # mine')
    text = text.replace('irradiance: ""', "irradiance: 860")
    said.write_text(text)
    code, printed = run(report.main, folder, "--device", "cpu", "--language", "de", "--format", "html", "--delta", 900)
    assert code == 0, printed
    page = (folder / "report" / "report.html").read_text()
    assert "Müller &lt;b&gt;&amp; Co&lt;/b&gt;" in page
    assert "Thermografiebericht" in page
    assert not re.search(
        r"\b(recalculated|thermal|world units|spot)\b", re.sub("<[^>]*>", " ", page).split("Ordner")[0]
    )
    assert "Nichts liegt jenseits der Grenze." in page
    assert "1000 W/m²" in page
    assert said.read_text() == text


@pytest.mark.slow
def test_report_without_degrees(run: Run, tmp_path: Path) -> None:
    """Intensities, said on the first page; nothing is in kelvin."""
    capture, folder = tmp_path / "capture", tmp_path / "run"
    shutil.copytree(str(files("thermosplat") / "sample"), capture)
    shutil.rmtree(capture / "thermal_raw")
    assert run(train.main, capture, *QUICK, "--max-steps", 1, "--result-dir", folder)[0] == 0
    code, printed = run(report.main, folder, "--device", "cpu", "--delta", 0.1, "--format", "html")
    assert code == 0, printed
    page = (folder / "report" / "report.html").read_text()
    assert page.index("values are intensities without a unit") < page.index("<h2")
    assert "data:image/png" in page
    assert "°C" not in page
    assert "ΔT" not in page
    assert not re.search(r"\d K\b", page)


def test_mistakes(run: Run, finished: Path) -> None:
    """No such measurement, an impossible difference, a report.yaml of something else: told before the search."""
    code, printed = run(report.main, finished, "--delta", -1)
    assert code == 2
    assert "--delta -1 is no difference" in printed
    code, printed = run(report.main, finished, "--device", "cpu", "--reference", "R9")
    assert code == 2
    assert "No measurement of thermal is called R9" in printed
    (finished / "report.yaml").write_text(json.dumps({"form": {"clint": "x"}}))
    code, printed = run(report.main, finished, "--device", "cpu")
    (finished / "report.yaml").unlink()
    assert code == 2
    assert "form.clint is unknown" in printed
