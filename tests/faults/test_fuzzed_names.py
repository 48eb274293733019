"""Names that a disk can hold and nobody expects, of files, folders and results: a result, or one sentence that is safe.

A name is made of control characters, bytes that are no UTF-8, marks that turn the direction of writing, lines, blanks,
signs of the shell and of formats, and is up to 255 bytes long.
"""

import contextlib
import io
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from camera_folders import write_two_cameras
from capture_folders import rgb_image, write_image, write_rgbt_scenes
from fuzzing import Fuzzer, main, number_of_cases, run_apart
from thermosplat.cli import evaluate, prepare, train
from thermosplat.prepare.capture_folder import CaptureFolder

PIECES = [
    *(b"a", b"IMG_", b"7", b" ", b"  ", b"\n", b"\r", b"\t", b"\x01", b"\x07", b"\x7f", b"\x1b[2J", b"\x1b]0;x\x07"),
    *("\x9b2J", "\u202e", "\u2066", "\u200f", "\ufeff", "\u200b", "\xa0", "ü", "u\u0308", "温度", "🌡", "\U000e0041"),
    *(b"\xff", b"\xfc", b"\xc3", b"\xed\xa0\x80", b"\xf4\x90\x80\x80", b"%s", b"%n", b"{x}", b"{0}", b"${HOME}"),
    *(b"$(id)", b"'", b'"', b"\\", b"`", b"*", b"?", b"~", b"-", b"--help", b"#", b",", b";", b"|", b"&", b"[bold]"),
    *(b"[link=x]", b"..", b"."),
]
"""What names are put together of."""
LONGEST = 255
"""Bytes of a name."""


def strange_name(rng: np.random.Generator, ending: str = "") -> str:
    """A name as Python has it, with surrogates for what is no UTF-8."""
    pieces = [PIECES[number] for number in rng.integers(0, len(PIECES), int(rng.choice([1, 2, 3, 6])))]
    name = b"".join(piece if isinstance(piece, bytes) else piece.encode() for piece in pieces)
    if rng.integers(0, 6) == 0:
        name *= LONGEST
    name = name[: LONGEST - len(ending)]
    return os.fsdecode(name if name not in (b".", b"..") else b"x") + ending


def said(command: Callable[[list[str]], int], *words: str | Path) -> int:
    """Run a command; what it prints has nothing that a terminal acts upon."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        code = command([str(word) for word in words])
    assert code in (0, 2), printed.getvalue()
    for line in printed.getvalue().split("\n"):
        assert line.isprintable(), ascii(line)
    assert "Traceback" not in printed.getvalue()
    return code


def make(root: Path) -> Fuzzer:
    """Two cameras' folder for the import, and a capture with a model."""
    write_two_cameras(root / "cameras")
    write_rgbt_scenes(root / "capture", 4, folders=False)
    said(prepare.main, "import", root / "cameras", "--out", root / "imported")
    os.chdir(root)  # for what has no other place

    def fuzzer(rng: np.random.Generator) -> str:
        work = root / "work"
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        kind = ["files", "folders", "damaged", "capture", "boards", "absent"][rng.integers(0, 6)]
        if kind in ("files", "folders", "damaged"):
            _import(root, work, kind, rng)
        elif kind == "capture":
            _read(root, work, rng)
        elif kind == "boards":
            _calibrate(root, work, rng)
        else:
            _name(work, rng)
        return kind

    return fuzzer


def _import(root: Path, work: Path, kind: str, rng: np.random.Generator) -> None:
    source = work / (strange_name(rng) if kind == "folders" else "cameras")
    shutil.copytree(root / "cameras", source)
    files = sorted(path for path in source.rglob("*") if path.is_file())
    if kind == "folders":
        folder = files[0].parent
        if folder != source:
            folder.rename(folder.with_name(strange_name(rng)))
    for path in [] if kind == "folders" else [files[number] for number in rng.integers(0, len(files), 3)]:
        if path.exists():
            path.rename(path.with_name(strange_name(rng, path.suffix)))
    if kind == "damaged":
        damaged = sorted(path for path in source.rglob("*") if path.is_file())[rng.integers(0, len(files))]
        damaged.write_bytes(damaged.read_bytes()[:100])
    (source / strange_name(rng, str(rng.choice(["", ".mp4", ".jpg", ".csv", ".tiff"])))).touch()
    out = work / (strange_name(rng) if rng.integers(0, 3) == 0 else "out")
    if said(prepare.main, "import", source, "--out", out) == 0:
        for row in CaptureFolder(out).read_frames():
            assert (out / "images" / row.spectrum / row.file).is_file()
        said(prepare.main, "pair", out)


def _read(root: Path, work: Path, rng: np.random.Generator) -> None:
    capture = work / (strange_name(rng) if rng.integers(0, 2) else "capture")
    shutil.copytree(root / "capture", capture)
    thermal = sorted((capture / "thermal").iterdir())
    thermal[0].rename(thermal[0].with_name(strange_name(rng, ".png")))
    write_image(capture / "rgb" / strange_name(rng, ".png"), rgb_image(9))
    if rng.integers(0, 2):
        shutil.rmtree(capture / "sparse")
    said(train.main, capture, "--device", "cuda:99", "--result-dir", work / strange_name(rng))


def _calibrate(root: Path, work: Path, rng: np.random.Generator) -> None:
    folders = [work / strange_name(rng) for _ in range(2)]
    for folder in folders:
        folder.mkdir(exist_ok=True)
        (folder / strange_name(rng, ".png")).write_bytes(b"no image")
    said(prepare.main, "calibrate", root / "imported", "--rgb", folders[0], "--thermal", folders[1])


def _name(work: Path, rng: np.random.Generator) -> None:
    name = work / strange_name(rng)
    words = [["--config", name], ["--thermal.palette", name], ["--lpips-weights", name], ["--resume", name]]
    said(train.main, "sample", "--device", "cuda:99", *words[rng.integers(0, 4)])
    said(evaluate.main, name)


@pytest.mark.rotating("fuzzed input")
def test_strange_names() -> None:
    """In imports, captures, results and whatever else has a name."""
    run_apart(__file__, number_of_cases(25))


if __name__ == "__main__":
    main(make)
