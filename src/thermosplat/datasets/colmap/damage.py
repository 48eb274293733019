"""What is wrong with the files of a COLMAP model, in words: pycolmap names its own source lines instead."""

from pathlib import Path

from thermosplat.datasets.colmap.record_lengths import wrong_lengths

_NEEDED = ("cameras", "images", "points3D")
_RIG = ("rigs", "frames")


def is_binary(folder: Path) -> bool:
    """Whether pycolmap would read the binary files of a folder, rather than those of text."""
    return all((folder / f"{name}.bin").is_file() for name in _NEEDED)


def damage_before_reading(folder: Path) -> str | None:
    """Missing files, and binary files that their records do not fill: on some pycolmap hangs or takes all memory."""
    return _special(folder) or _missing(folder) or wrong_lengths(folder)


def reason_of(error: Exception) -> str:
    """Why pycolmap could not read a model, without the place in its own source."""
    return " ".join(str(error).rpartition("] ")[2].split()).rstrip(".") or type(error).__name__


def _special(folder: Path) -> str | None:
    """A name of the model's files under which something else lies, such as a pipe, which is read for ever."""
    files = (f"{name}.{kind}" for name in (*_NEEDED, *_RIG) for kind in ("bin", "txt"))
    return next((f"{file} is no file" for file in files if (folder / file).exists() != (folder / file).is_file()), None)


def _missing(folder: Path) -> str | None:
    kinds = {kind: [name for name in _NEEDED if not (folder / f"{name}.{kind}").is_file()] for kind in ("bin", "txt")}
    kind = min(kinds, key=lambda kind: len(kinds[kind]))
    lacking = kinds[kind]
    if not lacking:  # a rig is in two files or, before COLMAP 3.12, in none
        rig = [name for name in _RIG if not (folder / f"{name}.{kind}").is_file()]
        lacking = rig if len(rig) == 1 else []
    if not lacking:
        return None
    there = ", ".join(sorted(path.name for path in folder.iterdir() if path.suffix == f".{kind}"))
    names = " and ".join(f"{name}.{kind}" for name in lacking)
    return f"{names} {'is' if len(lacking) == 1 else 'are'} missing beside {there}"
