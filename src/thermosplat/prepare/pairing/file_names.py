"""What the names of two cameras' files have in common: name, number, folder and time, without what tells them apart."""

import re
from datetime import UTC, datetime
from pathlib import PurePosixPath
from string import ascii_lowercase

from thermosplat.prepare.capture_folder import FrameRow
from thermosplat.prepare.importing.camera_groups import named_role

_CAMERA_FOLDER = re.compile(r"(\d{3})[A-Za-z0-9_]{5}")
"""100MEDIA, 100CANON, 101_FLIR: a number and five letters of the maker (DCF, JEITA CP-3461)."""
_CAMERA_LETTERS = "vwtrz"
"""Folders of DJI's cameras: visible, wide, thermal, radiometric, zoom."""
_DATE_AND_TIME = re.compile(
    r"(?<!\d)(20\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_T. ]{0,3}(\d\d)[-_.:]?(\d\d)[-_.:]?(\d\d)"
    r"(\d{3}(?!\d)|[.,]\d{1,6})?(?!\d)"
)
"""20261120_101506, 2026-11-20T10-15-06.25, 20261120101506123."""
_SINCE_1970 = re.compile(r"(?<!\d)(1[1-9]\d{8})(?:[._]?(\d{9}|\d{6}|\d{3})|\.(\d{1,9}))?(?!\d)")
"""Seconds, perhaps with thousandths, millionths or billionths, as robots name their images; 2004 to 2033."""


def name_key(row: FrameRow) -> str | None:
    """The file's name without the words that tell the cameras apart, in lower case."""
    name, _, frame = row.source.partition("#")
    return " ".join(filter(None, [_common_words(PurePosixPath(name).stem), frame])) or None


def number_key(row: FrameRow) -> str | None:
    """The last number in the file's name that is no time, without leading zeros; of a video frame its number."""
    name, _, frame = row.source.partition("#")
    numbers = re.findall(r"\d+", _time_and_rest(PurePosixPath(name).stem)[1])
    return frame or (str(int(numbers[-1])) if numbers else None)


def folder_key(row: FrameRow) -> str:
    """The file's folders, likewise; of a camera's own folder its number. Empty for none."""
    folders = PurePosixPath(row.source.partition("#")[0]).parts[:-1]
    kept = [
        numbered[1] if (numbered := _CAMERA_FOLDER.fullmatch(one)) else _common_words(one, _CAMERA_LETTERS)
        for one in folders
    ]
    return "/".join(filter(None, kept))


def name_time(row: FrameRow) -> float | None:
    """The time in the file's name [s] since 1970, as if it were UTC; None where there is none."""
    return _time_and_rest(PurePosixPath(row.source.partition("#")[0]).stem)[0]


def is_named_by_time(row: FrameRow) -> bool:
    """Nothing but a time tells the file from others of its camera."""
    return name_time(row) is not None and number_key(row) is None


def _time_and_rest(stem: str) -> tuple[float | None, str]:
    """The time in a name, and the name without it."""
    if (found := _DATE_AND_TIME.search(stem)) is not None:
        *numbers, fraction = found.groups()
        try:
            moment = datetime(*map(int, numbers), tzinfo=UTC)  # type: ignore[misc, arg-type]
        except ValueError:
            return None, stem
        seconds = moment.timestamp() + float(f"0.{(fraction or '').lstrip('.,') or 0}")
    elif (found := _SINCE_1970.search(stem)) is not None:
        seconds = float(f"{found[1]}.{found[2] or found[3] or 0}")
    else:
        return None, stem
    return seconds, f"{stem[: found.start()]} {stem[found.end() :]}"


def _common_words(name: str, letters: str = ascii_lowercase) -> str:
    """The words of a name without those for a camera, and without a last one that is one of some letters."""
    words = [word for word in re.split(r"[^a-z0-9]+", name, flags=re.IGNORECASE) if word]
    if words and len(words[-1]) == 1 and words[-1].lower() in letters:
        words.pop()
    return " ".join(word for word in words if not named_role(word)).lower()
