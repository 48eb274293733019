"""thermosplat-prepare's commands for files: what they print, the next command, exit codes."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from camera_folders import write_two_cameras
from sample_runs import Run
from thermosplat.cli import prepare, train


def test_steps_name_the_next_one(run: Run, tmp_path: Path) -> None:
    """import, pair, check; a second time each is complete already; training says what is missing."""
    out = tmp_path / "a capture"
    code, printed = run(prepare.main, "import", write_two_cameras(tmp_path / "in"), "--out", out)
    assert code == 0
    assert "6 RGB images of 96x72 px and 6 thermal images of 48x36 px." in printed
    assert f"Next: thermosplat-prepare pair '{out}'" in printed
    code, printed = run(prepare.main, "pair", out)
    assert code == 0
    assert "6 pairs of 6 photographs" in printed
    assert f"Next: thermosplat-prepare sfm '{out}'" in printed
    code, printed = run(prepare.main, "check", out)
    assert code == 0
    assert f"Look at '{out}/check/index.html'" in printed
    assert "\n\n" not in printed
    assert run(prepare.main, "pair", out)[1].startswith("pair: complete already.")
    code, printed = run(train.main, out)
    assert code == 2
    assert f"thermosplat-prepare sfm '{out}'" in printed


def test_place_of_the_capture(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without --out it is captures/<name of the folder> in the current folder."""
    monkeypatch.chdir(tmp_path)
    assert run(prepare.main, "import", write_two_cameras(tmp_path / "shed"))[0] == 0
    assert (tmp_path / "captures" / "shed" / "frames.csv").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["import", "{}/none"], "none does not exist"),
        (["{}/none"], "none does not exist"),
        (["import"], "No folder given"),
        ([], "No folder given"),
        (["pair", "{}"], "no capture that thermosplat-prepare import has finished"),
        (["check", "{}"], "no capture that thermosplat-prepare import has finished"),
        (["import", "--thermal", "{}", "--out", "{}/made"], "folder of the photographs is missing"),
        (["import", "--rgb", "{}", "--further", "nir"], "--further nir is not NAME=DIR"),
        (["import", "{}", "--every", "0"], "--every must be at least 1"),
        (["import", "{}", "--unit", "rankine"], "--unit rankine is not known"),
        (["import", "{}", "--range", "30", "10"], "--range must be MIN MAX"),
        (["pair", "{}", "--by", "magic"], "magic"),
    ],
)
def test_mistakes_end_with_2(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], message: str
) -> None:
    """With a sentence, and nothing is written, neither there nor into the current folder."""
    monkeypatch.chdir(tmp_path)
    code, printed = run(prepare.main, *(word.format(tmp_path) for word in words))
    assert code == 2
    assert "".join(message.split()) in "".join(printed.replace("│", "").split())  # the panel breaks long lines
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [["folder"], ["sfm", "folder"]])
def test_ctrl_c_says_that_the_command_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    """In the whole command and in a step of its own."""

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("thermosplat.cli.preparing.files.import_source", stopped)
    monkeypatch.setitem(prepare.STEPS, "sfm", (prepare.STEPS["sfm"][0], stopped))
    assert prepare.main(words) == 130
    assert "What was done is kept. The same command goes on." in capsys.readouterr().err


def test_flags_that_need_each_other(run: Run, tmp_path: Path) -> None:
    """A scale without a unit."""
    write_two_cameras(tmp_path / "in")
    code, printed = run(prepare.main, "import", tmp_path / "in", "--out", tmp_path / "out", "--scale", "0.04")
    assert code == 2
    assert "--scale and --offset need the unit" in printed
    code, printed = run(
        prepare.main, "import", tmp_path / "in", "--out", tmp_path / "out", "--scale", "10", "--unit", "celsius"
    )
    assert code == 2
    assert "read as Celsius are impossible" in printed


def test_a_killed_import_goes_on(run: Run, tmp_path: Path) -> None:
    """SIGKILL in the middle leaves whole images only, and the same command completes them."""
    write_two_cameras(tmp_path / "in", 40)
    out = tmp_path / "out"
    script = (
        "import sys, time\n"
        "from thermosplat.prepare.importing import thermal_images\n"
        "write = thermal_images.write_png\n"
        "thermal_images.write_png = lambda path, image: (write(path, image), time.sleep(0.05))\n"
        "from thermosplat.cli.prepare import main\n"
        f"main(['import', {str(tmp_path / 'in')!r}, '--out', {str(out)!r}])\n"
    )
    path = [str(Path(__file__).parents[2] / "src"), *sys.path]
    process = subprocess.Popen([sys.executable, "-c", f"import sys; sys.path[:0] = {path!r}\n{script}"])
    thermal = out / "images" / "thermal"
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and len(list(thermal.glob("IR_*.png"))) < 5:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = {file: file.stat().st_mtime_ns for file in thermal.glob("IR_*.png")}
    assert 5 <= len(done) < 40
    assert not (out / "prepared" / "import.json").exists()
    assert run(prepare.main, "pair", out)[0] == 2
    assert run(prepare.main, "import", tmp_path / "in", "--out", out)[0] == 0
    assert len(list(thermal.glob("IR_*.png"))) == 40
    assert all(file.stat().st_mtime_ns == when for file, when in done.items())
