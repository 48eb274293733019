"""Which files of a folder are photographs and which are thermal images.

What a file holds decides first: measured values are thermal. Names come next: words in the file's name, then in its
folders' from the deepest up (IR_0001, DJI_0001_T, VisJPG/). What neither decides is told by looking at a few images:
grey ones and those in a palette's colours are thermal.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from thermosplat.datasets.images.flir_metadata import read_flir_palette
from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import LEADING, OTHER
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.importing.source_files import SourceFile
from thermosplat.thermal.radiometry import FLIR_IRON

_WORDS = {
    LEADING: frozenset(
        ["rgb", "visible", "vis", "visual", "photo", "photos", "color", "colour", "optical", "wide", "digital", "dc"]
    ),
    OTHER: frozenset(
        ["thermal", "ir", "tir", "lwir", "infrared", "rad", "radiometric", "therm", "thermo", "temperature", "flir"]
    ),
    "msx": frozenset({"msx", "blend", "pip"}),
    "zoom": frozenset({"zoom"}),
}
"""Words in names of files and folders that say what an image is."""
_NEAR_INFRARED = re.compile("near[ _-]?(infrared|ir)", re.IGNORECASE)
"""A further spectrum, which is not thermal."""
_LETTERS = {LEADING: "wv", OTHER: "tr", "zoom": "z"}
"""The same as single letters at the end of a name: DJI's wide, visible, thermal, radiometric and zoom cameras."""
PALETTE_LIMIT = 25.0
"""Mean distance of an image's colours from FLIR Iron or its own palette [8-bit levels] up to which it is
pseudo-colour; measured in capture_palette.py."""
_GREY_LIMIT = 10.0
"""Mean difference between the channels of a colour image [8-bit levels] up to which it is grey; white-hot pictures of
cameras have 2 to 8."""
_SAMPLED = 3
_LARGEST_SENSOR = 2048 * 1536
"""Pixels of the largest pictures of uncooled thermal cameras (FLIR's UltraMax, which makes four of one)."""
_LARGER = 2
"""How many times the pixels of thermal pictures photographs beside them have at least."""


@dataclass(frozen=True)
class Groups:
    """The files by spectrum, and what was said about those that are left out."""

    files: Mapping[str, tuple[SourceFile, ...]]
    sentences: tuple[str, ...] = field(default=())


def group_files(files: Sequence[SourceFile]) -> Groups:
    """Tell photographs from thermal files.

    Returns:
        Files of "rgb" and "thermal", each perhaps none.

    Raises:
        UserError: A further folder has images of which nothing says what they are.
    """
    _refuse_further_folders(files)
    roles: dict[str, list[SourceFile]] = {LEADING: [], OTHER: [], "msx": [], "zoom": [], "": []}
    for file in files:
        role = named_role(file.name)
        if role == "" or (role in ("msx", "zoom") and file.kind == "values"):
            role = OTHER if file.is_radiometric else ""
        roles[role].append(file)
    _add_unnamed(roles)
    sentences = []
    if roles["zoom"] and not roles[LEADING]:
        roles[LEADING], roles["zoom"] = roles["zoom"], []
        sentences.append("The photographs are of the zoom camera, whose field of view must be the same in all.")
    if roles["msx"] and not roles[OTHER]:
        roles[OTHER], roles["msx"] = roles["msx"], []
    for role, why in (("zoom", "of the zoom camera: its field of view changes"), ("msx", "with visible edges (MSX)")):
        if roles[role]:
            sentences.append(
                f"{counted(len(roles[role]), 'image')} {why} {agreeing(len(roles[role]), 'was', 'were')} left out "
                f"(first: {roles[role][0].name})."
            )
    return Groups({LEADING: tuple(roles[LEADING]), OTHER: tuple(roles[OTHER])}, tuple(sentences))


def named_role(name: str) -> str:
    """What a file's path says that it is: "rgb", "thermal", "msx", "zoom" or "" for nothing."""
    path = PurePosixPath(name)
    for place, part in enumerate([path.stem, *reversed(path.parts[:-1])]):
        part = _NEAR_INFRARED.sub("nir", part)
        words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", part)]
        for word in reversed(words):
            for role, known in _WORDS.items():
                if word in known and not (word == "flir" and place == 0):  # FLIR0001.jpg may be either
                    return role
        if place == 0 and len(words) > 1 and re.search(r"[_-][A-Za-z]$", part):
            for role, letters in _LETTERS.items():
                if words[-1] in letters:
                    return role
    return ""


def _refuse_further_folders(files: Sequence[SourceFile]) -> None:
    """Refuse images in a folder of their own that no name tells, beside named photographs and thermal files."""
    named: dict[str, set[PurePosixPath]] = {}
    for file in files:
        named.setdefault(named_role(file.name), set()).add(PurePosixPath(file.name).parent)
    told = {folder for role, folders in named.items() if role for folder in folders}
    further = sorted(named.get("", set()) - told)
    if not (LEADING in named and OTHER in named and further):
        return
    inside = [file for file in files if PurePosixPath(file.name).parent == further[0]]
    raise UserError(
        f"The folder {further[0]}/ has {counted(len(inside), 'image')}, and nothing says whether they are photographs "
        f"or thermal images (first: {inside[0].name}).",
        "Name the folders: --rgb DIR --thermal DIR, and --further nir=DIR for another spectrum that shows the "
        "photographs' view. Or take the folder away.",
    )


def _add_unnamed(roles: dict[str, list[SourceFile]]) -> None:
    """Put files of which no name says anything to the spectrum that they look like."""
    unnamed, roles[""] = roles[""], []
    by_camera: dict[tuple[object, ...], list[SourceFile]] = {}
    for file in unnamed:
        camera = (file.exif.make, file.exif.model, file.width, file.height, file.kind, file.frame and file.name)
        by_camera.setdefault(camera, []).append(file)
    measured = any(file.is_radiometric for file in roles[OTHER])
    alike = {kind for kind, group in by_camera.items() if not measured and looks_thermal(group)}
    sizes = [_pixels(by_camera[kind][0]) for kind in alike] + [_pixels(file) for file in roles[OTHER]]
    for kind, group in by_camera.items():
        # photographs of a grey wall look thermal, too: they are larger, and have a sensitivity
        photographs = _pixels(group[0]) > min(_LARGEST_SENSOR, _LARGER * min(sizes, default=_LARGEST_SENSOR))
        sensitive = any(file.exif.iso is not None for file in group)
        roles[OTHER if kind in alike and not (photographs or sensitive) else LEADING] += group
    for role in (LEADING, OTHER):
        roles[role].sort(key=lambda file: (file.name, file.frame or 0))


def _pixels(file: SourceFile) -> int:
    return file.width * file.height


def looks_thermal(files: Sequence[SourceFile]) -> bool:
    """Whether images look like pictures of temperatures: grey, or colours of FLIR Iron or the palette in the file."""
    step = max(1, len(files) // _SAMPLED)
    votes = [_is_thermal_picture(file.path) for file in files[::step][:_SAMPLED] if file.frame is None]
    return 2 * sum(votes) > len(votes)


def _is_thermal_picture(path: Path) -> bool:
    image = read_image(path)[::4, ::4]
    if image.ndim == 2:
        return True
    if image.dtype != np.uint8:
        return False
    if float(np.ptp(image.astype(np.int16), axis=-1).mean()) <= _GREY_LIMIT:
        return True
    palette = read_flir_palette(path) or FLIR_IRON
    return palette.residual(image / np.float32(255)) <= PALETTE_LIMIT


def prefer_values(files: Sequence[SourceFile]) -> tuple[list[SourceFile], list[str]]:
    """Of thermal files the radiometric ones, if there are any; of those the most frequent kind.

    Returns:
        The files to take, and what to say about the others.
    """
    kinds = Counter(file.kind for file in files if file.is_radiometric)
    emptied = [file for file in files if not file.is_radiometric and _is_of_radiometric_maker(file)]
    said = []
    if emptied:
        count = counted(len(emptied), "thermal picture holds", "thermal pictures hold")
        said = [
            f"{count} no measured values, though cameras of this maker save them (first: {emptied[0].name}): a program "
            "has saved the pictures again without them, or the camera was not set to. Copy them from the card again."
        ]
    if not kinds:
        return list(files), said
    best = kinds.most_common(1)[0][0]
    taken = [file for file in files if file.kind == best]
    left = [file for file in files if file.kind != best]
    if not left:
        return taken, said
    return taken, [
        *said,
        f"{counted(len(left), 'thermal picture')} without temperatures {agreeing(len(left), 'was', 'were')} left out, "
        f"because {counted(len(taken), 'file has', 'files have')} them "
        f"(first left out: {left[0].name}).",
    ]


def _is_of_radiometric_maker(file: SourceFile) -> bool:
    maker = (file.exif.make or "").lower()
    return file.frame is None and file.kind in ("color", "grey") and maker.startswith(("dji", "flir"))


def one_camera(
    spectrum: str, files: Sequence[SourceFile], take_most: bool, turn_back: int | None = None
) -> tuple[list[SourceFile], list[str]]:
    """Images of one camera at one size.

    Args:
        take_most: Of several cameras or sizes take the most frequent.
        turn_back: Degrees by which images whose sides are swapped are turned clockwise; None: they are refused.

    Returns:
        The images to take, and what to say about the others.

    Raises:
        UserError: There are several, and nothing says what to do with them.
    """
    kinds: Counter[tuple[str, int, int]] = Counter(_camera(file) for file in files)
    if len(kinds) <= 1:
        return list(files), []
    best = kinds.most_common(1)[0][0]
    swapped = best[0], best[2], best[1]
    left = [file for file in files if _camera(file) != best]
    turned = [file for file in left if _camera(file) == swapped]
    if turned and turn_back is not None:
        back = [replace(file, turn=turn_back) if file in turned else file for file in files]
        taken, said = one_camera(spectrum, back, take_most)
        count = counted(len(turned), f"{spectrum} image was", f"{spectrum} images were")
        return taken, [f"{count} turned by {turn_back}° (first: {turned[0].name}).", *said]
    described = ", ".join(
        f"{count} of {width}x{height} px{f' ({camera})' if camera else ''}"
        for (camera, width, height), count in kinds.most_common(4)
    )
    first = f"first of the others: {left[0].name}"
    if take_most:
        gone = (
            f"{counted(len(left), f'{spectrum} image')} of another camera or size {agreeing(len(left), 'was', 'were')}"
        )
        return [file for file in files if _camera(file) == best], [f"{gone} left out: {described}; {first}."]
    message = f"The {spectrum} images are of {len(kinds)} cameras or sizes: {described}; {first}."
    if len(turned) == len(left):
        raise UserError(
            f"{message} The others were turned by a program.",
            "Turn them back, clockwise: --turn-back 90, or 270. Or copy them from the camera again, or leave them out: "
            "--take-most",
        )
    raise UserError(
        f"{message} All images of a spectrum must come from one camera at one zoom and size.",
        "Take the most frequent alone with --take-most, or name the folders: --rgb DIR --thermal DIR",
    )


def _camera(file: SourceFile) -> tuple[str, int, int]:
    width, height = (file.height, file.width) if file.turn else (file.width, file.height)
    if file.kind in ("flir", "dji"):  # the values stay as the sensor has them when a program turns the picture
        width, height = max(width, height), min(width, height)
    return " ".join(filter(None, (file.exif.make, file.exif.model))), width, height
