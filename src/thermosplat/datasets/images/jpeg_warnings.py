"""JPEG files whose data is damaged: their decoder fills what it lacks and says so on the standard error alone.

libjpeg, inside OpenCV, has no other way to tell. So a process of its own decodes the files once more, at an eighth of
their size, and its standard error is read. Other threads' output is not touched by that.
"""

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile

from thermosplat.datasets.images.image_files import JPEG_SUFFIXES
from thermosplat.errors import UserError

DECODER = Path(__file__).with_name("jpeg_decoder.py")
_FILES_PER_PROCESS = 128
"""A process takes 0.3 s to start, and some milliseconds for a file of a megapixel."""
_DAMAGE = (b"Corrupt JPEG data", b"Premature end", b"Inconsistent progression")
"""How libjpeg's warnings about the picture begin; others are about its description."""
_NO_DAMAGE = b"ICC"
"""In a warning about a colour profile, which is not used."""
_EXTRANEOUS = re.compile(rb"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9")
_TOLERATED = 16
"""Bytes between the picture's data and the end mark (0xd9) that are no damage: cameras and phones write a few there."""
_Stamp = tuple[str, int, int]
_whole: set[_Stamp] = set()
"""Files of this process that were found whole, with the time of their last change and their size."""
_alone = False
"""Whether this process decodes images and does nothing else."""


def check_jpegs(paths: Sequence[Path]) -> None:
    """Refuse JPEG files that libjpeg warns of.

    Args:
        paths: Image files that could be read (``read_image``); those of another ending are left out.

    Raises:
        UserError: One is damaged. Names it, and what libjpeg says.
    """
    stamps = {path: _stamp(path) for path in paths if path.suffix.lower() in JPEG_SUFFIXES}
    wanted = [path for path, stamp in stamps.items() if stamp not in _whole]
    if not wanted:
        return
    warned = damaged_jpegs(wanted)
    for path in wanted:
        if path in warned:
            raise _damaged(path, warned[path])
        _whole.add(stamps[path])


def damaged_jpegs(paths: Sequence[Path]) -> dict[Path, str]:
    """What libjpeg says of each of these JPEG files that it warns of.

    Raises:
        UserError: A file ended the process that decodes.
    """
    parts = max(1, min(-(-len(paths) // _FILES_PER_PROCESS), os.cpu_count() or 1))
    with ThreadPoolExecutor(parts) as pool:
        found = pool.map(_warnings, (paths[part::parts] for part in range(parts)))
        return {path: said for part in found for path, said in part.items()}


def decode_alone() -> None:
    """Say that this process decodes images and does nothing else meanwhile, so that its standard error is the decoder's
    while it does (``refusing_damage``)."""
    global _alone
    _alone = True


@contextmanager
def refusing_damage(path: Path) -> Iterator[None]:
    """Around the decoding of a file in a process that decodes alone: refuse a JPEG file that libjpeg warns of.

    Elsewhere nothing happens; there ``check_jpegs`` looks first.

    Raises:
        UserError: As ``check_jpegs``.
    """
    if not _alone or path.suffix.lower() not in JPEG_SUFFIXES:
        yield
        return
    with TemporaryFile() as heard:
        usual = os.dup(2)
        os.dup2(heard.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(usual, 2)
            os.close(usual)
        heard.seek(0)
        said = next(filter(_tells_damage, heard.read().splitlines()), None)
    if said is not None:
        raise _damaged(path, said.decode(errors="replace"))


def _damaged(path: Path, said: str) -> UserError:
    return UserError(
        f"{path} is damaged ({said}).",
        "Restore it, or remove it from the folder. If it looks whole, save it again with another program.",
    )


def _stamp(path: Path) -> _Stamp:
    status = path.stat()
    return os.path.abspath(path), status.st_mtime_ns, status.st_size


def _warnings(paths: Sequence[Path]) -> dict[Path, str]:
    """What the decoder says of the picture in each file that it warns of."""
    process = subprocess.run(
        [sys.executable, "-P", str(DECODER)],
        input=b"\0".join(os.fsencode(os.path.abspath(path)) for path in paths),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        check=False,
    )
    # the decoder writes a zero byte before each file, and one after the last
    _, *parts = process.stderr.split(b"\0")
    if process.returncode != 0 or len(parts) != len(paths) + 1:
        raise UserError(
            f"{paths[min(max(len(parts) - 1, 0), len(paths) - 1)]} ended the process that looks for damaged JPEG files "
            f"(exit code {process.returncode}).",
            "Remove that file from the folder. If that does not help, please report it.",
        )
    warned = {}
    for path, said in zip(paths, parts):
        lines = [line for line in said.splitlines() if _tells_damage(line)]
        if lines:
            warned[path] = lines[0].decode(errors="replace")
    return warned


def _tells_damage(line: bytes) -> bool:
    """Whether a warning means that pixels are wrong."""
    if not line.startswith(_DAMAGE) or _NO_DAMAGE in line:
        return False
    extraneous = _EXTRANEOUS.match(line)
    return extraneous is None or int(extraneous[1]) > _TOLERATED
