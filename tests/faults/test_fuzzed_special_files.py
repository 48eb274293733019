"""Special files and links in every folder that is read: a result, or one sentence, and never an endless wait.

Of a capture in each layout, and of a folder of cameras' files through the steps of its preparation, something is put in
the place of a file or beside it that is none: a pipe, a socket, a device, a folder, a link to nothing, to itself, to a
folder above or to the system's own.
"""

import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from camera_folders import write_two_cameras
from capture_folders import (
    HEIGHT,
    WIDTH,
    write_colmap_folder,
    write_image,
    write_rgbt_scenes,
    write_rig,
    write_transforms,
)
from fuzzing import Fuzzer, main, number_of_cases, run_apart
from thermosplat.datasets import load_capture
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.checking.check import check
from thermosplat.prepare.importing.import_files import ImportOptions, import_files
from thermosplat.prepare.pairing.pairing import pair_frames

LINKS = ("/dev/zero", "/dev/stdin", "/dev/tty", "/proc", "/proc/self/fd", "/sys", "/", "none", "..", ".")
NAMES = (
    "0001.png",
    "units.json",
    "x.tiff",
    "y.mp4",
    "z.HEIC",
    "images",
    "thermal",
    "masks",
    "shutter.json",
    "rigs.bin",
)


def put(path: Path, rng: np.random.Generator) -> str:
    """Something that is no file, in the place of whatever is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    kind = rng.choice(["pipe", "socket", "folder", "itself", *LINKS])
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as there:  # by a short name: a socket's path is limited
            here = os.open(".", os.O_RDONLY)
            os.chdir(path.parent)
            there.bind(path.name)
            os.fchdir(here)
            os.close(here)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(path.name if kind == "itself" else kind)
    return str(kind)


def prepared(root: Path) -> None:
    """Steps that need no structure from motion."""
    capture = CaptureFolder(root / "capture")
    import_files(root / "in", capture, ImportOptions(skip_unreadable=bool(len(list(root.iterdir())) % 2)))
    pair_frames(capture)
    check(capture)


def complete(root: Path) -> None:
    """A capture with masks, a palette, times and a shutter."""
    write_rgbt_scenes(root, raw=True)
    write_image(root / "masks" / "0001.png", np.tri(HEIGHT, WIDTH, dtype=np.uint8))
    (root / "ironbow_lut.json").write_text('{"lut": [[0, 0, 0], [255, 255, 255]]}')
    (root / "shutter.json").write_text('{"thermal": {"readout": 0.01, "interval": 1}}')


CASES: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "rgbt": (complete, load_capture),
    "colmap": (write_colmap_folder, load_capture),
    "rig": (write_rig, load_capture),
    "transforms": (write_transforms, load_capture),
    "cameras": (lambda root: write_two_cameras(root / "in"), prepared),
    "prepared": (lambda root: prepared(write_two_cameras(root / "in").parent), prepared),
}


def make(root: Path) -> Fuzzer:
    """Each case changes a copy of what was written once."""
    for name, (write, _) in CASES.items():
        (root / "whole" / name).mkdir(parents=True)
        write(root / "whole" / name)

    def fuzzer(rng: np.random.Generator) -> str:
        name = str(rng.choice(list(CASES)))
        shutil.rmtree(root / "tried", ignore_errors=True)
        shutil.copytree(root / "whole" / name, root / "tried")
        said = [name]
        for _ in range(rng.integers(1, 3)):
            places = sorted((root / "tried").rglob("*"))
            folders = [place for place in (root / "tried", *places) if place.is_dir() and not place.is_symlink()]
            beside = folders[rng.integers(0, len(folders))] / str(rng.choice(NAMES))
            path = beside if rng.random() < 0.3 else places[rng.integers(0, len(places))]
            said.append(f"{path.relative_to(root / 'tried')}: {put(path, rng)}")
        CASES[name][1](root / "tried")
        return ", ".join(said)

    return fuzzer


@pytest.mark.rotating("fuzzed input")
def test_special_files_anywhere():
    """In bounded time and memory, whatever command reads the folder."""
    run_apart(__file__, number_of_cases(40))


if __name__ == "__main__":
    main(make)
