"""The files of a folder, one by one: what each is, before anybody asks which camera it came from.

A file is a photograph or pseudo-colour (8-bit colour), grey, or radiometric: 16-bit or floating-point values, or a JPEG
with FLIR's or DJI's radiometric data inside. A video stands for some of its frames.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_bytes import ImageHeader, image_header, read_regular_file
from thermosplat.datasets.images.image_files import IMAGE_SUFFIXES, JPEG_SUFFIXES, list_images, read_image
from thermosplat.datasets.images.jpeg_segments import is_whole_jpeg
from thermosplat.datasets.images.jpeg_warnings import damaged_jpegs
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import Exif, FrameRow
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.importing.dji_files import is_dji_thermal
from thermosplat.prepare.importing.exif import parse_exif, read_exif
from thermosplat.prepare.importing.flir_files import is_flir
from thermosplat.prepare.importing.video_frames import VIDEO_SUFFIXES, describe_video, moment, read_video_frame
from thermosplat.printing import printable
from thermosplat.regular_files import files_below

Kind = Literal["color", "grey", "values", "flir", "dji"]
_BOARD_FOLDERS = ("calib", "board", "checker", "charuco")
"""Folders whose names begin like this hold pictures of a board, for ``calibrate``."""


@dataclass(frozen=True)
class SourceFile:
    """One image that a camera wrote.

    Args:
        name: The file's path relative to the folder that is imported.
        kind: "color" and "grey" have 8 bits, "values" more; "flir" and "dji" are JPEGs with radiometric data inside.
        width: [px] of the stored pixels.
        height: [px].
        exif: When, where and with what it was taken.
        frame: Number of the frame in a video; None for an image file.
        turn: Degrees by which its pixels are turned clockwise, to be like those of the others.
    """

    path: Path
    name: str
    kind: Kind
    width: int
    height: int
    exif: Exif
    frame: int | None = None
    turn: int = 0

    @property
    def is_radiometric(self) -> bool:
        """It holds measured values, not only a picture of them."""
        return self.kind in ("values", "flir", "dji")

    @property
    def source(self) -> str:
        """As frames.csv names it."""
        name = printable(self.name)
        return name if self.frame is None else f"{name}#{self.frame}"

    def read(self) -> NDArray[Any]:
        """Its pixels as ``read_image`` gives them.

        Raises:
            UserError: They cannot be decoded.
        """
        return self.turned(read_image(self.path) if self.frame is None else read_video_frame(self.path, self.frame))

    def turned(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Pixels of this file [H, W, ...], turned as it has to be."""
        return np.ascontiguousarray(np.rot90(pixels, -self.turn // 90)) if self.turn else pixels

    def row(self, spectrum: str, file: str, width: int, height: int) -> FrameRow:
        """The row of frames.csv for an image of a capture that is made of this one.

        Args:
            width: [px].
            height: [px].
        """
        return FrameRow(spectrum, file, self.source, width, height, **asdict(self.exif))


@dataclass(frozen=True)
class SourceFolder:
    """What a folder holds.

    Args:
        files: Its images in the order of their names, frames of videos among them.
        unreadable: Files that cannot be read, each with the reason.
        others: Number of files that are no images.
        foreign: A sentence for each format of thermal cameras that is not read.
    """

    files: tuple[SourceFile, ...]
    unreadable: tuple[tuple[Path, str], ...]
    others: int
    foreign: tuple[str, ...] = ()


def read_folder(
    folder: Path,
    *,
    every: int = 1,
    skip: Sequence[Path] = (),
    progress: Callable[[Iterable[Path], int], Iterable[Path]] = lambda paths, _: paths,
) -> SourceFolder:
    """Look at every image and video below a folder.

    Args:
        folder: The folder. Folders of pictures of a board, hidden ones and prepared captures are left out.
        every: Of a video every so many frames are taken.

    Raises:
        UserError: There is no such folder.
    """
    if not folder.is_dir():
        what = "is a file, not a folder" if folder.exists() else "does not exist"
        raise UserError(f"{folder} {what}.", "Give the folder that holds the photographs and the thermal files.")
    left_out = {path.resolve() for path in skip}
    paths = [path for path in list_images(folder, recursive=True) if _is_wanted(path, folder, left_out)]
    everything = files_below(folder)
    videos = sorted(path for path in everything if path.suffix.lower() in VIDEO_SUFFIXES)
    videos = [path for path in videos if _is_wanted(path, folder, left_out)]
    files: list[SourceFile] = []
    unreadable: list[tuple[Path, str]] = []
    with ThreadPoolExecutor() as pool:
        for path, found in zip(progress(paths, len(paths)), pool.map(lambda path: _look_at(path, folder), paths)):
            if isinstance(found, str):
                unreadable.append((path, found))
            else:
                files.append(found)
    jpegs = [file.path for file in files if file.path.suffix.lower() in JPEG_SUFFIXES]
    damaged = damaged_jpegs(jpegs) if jpegs else {}
    files = [file for file in files if file.path not in damaged]
    unreadable += damaged.items()
    for path in videos:
        try:
            files += _video_frames(path, folder, every)
        except UserError as error:
            unreadable.append((path, error.message))
    others = sum(path.suffix.lower() not in IMAGE_SUFFIXES | VIDEO_SUFFIXES for path in everything)
    foreign = foreign_sentences([path for path in everything if _is_wanted(path, folder, left_out)], folder)
    return SourceFolder(tuple(files), tuple(unreadable), others, tuple(foreign))


def _is_wanted(path: Path, folder: Path, left_out: set[Path]) -> bool:
    for parent in path.parents:
        if parent == folder:
            return True
        if parent.name.startswith(".") or parent.name.lower().startswith(_BOARD_FOLDERS):
            return False
        if parent.resolve() in left_out or (parent / "prepared" / "import.json").exists():
            return False
    return True


def _look_at(path: Path, folder: Path) -> SourceFile | str:
    """The file, or why it cannot be read."""
    name = path.relative_to(folder).as_posix()
    try:
        is_jpeg = path.suffix.lower() in JPEG_SUFFIXES
        content = read_regular_file(path) if is_jpeg else b""
        header = image_header(content) or _decoded(path)
        kind: Kind = "values" if header.is_radiometric else "grey" if header.channels == 1 else "color"
        if is_jpeg:
            exif = parse_exif(content)
            kind = "flir" if is_flir(content) else "dji" if is_dji_thermal(content, exif.make) else kind
            if not is_whole_jpeg(content) and kind != "dji":  # the XT S writes no end of its picture
                return "it is cut off"
        else:
            exif = read_exif(path)
    except UserError as error:
        return error.message.replace(str(path), "it", 1).rstrip(".")
    except OSError as error:
        return str(error.strerror or error)
    return SourceFile(path, name, kind, header.width, header.height, exif)


def _decoded(path: Path) -> ImageHeader:
    """What an image has, by its pixels: so a damaged file is found, for which JPEGs have an end to be looked for."""
    image = read_image(path)
    height, width = image.shape[:2]
    channels = 1 if image.ndim == 2 else 3
    return ImageHeader.of(width, height, channels, channels, np.dtype(image.dtype).itemsize)


def _video_frames(path: Path, folder: Path, every: int) -> list[SourceFile]:
    """Every so many frames of a video, as sources of their own."""
    count, rate, width, height = describe_video(path)
    first = SourceFile(path, path.relative_to(folder).as_posix(), "color", width, height, Exif(), 0)
    return [replace(first, frame=number, exif=Exif(time=moment(number / rate))) for number in range(0, count, every)]


_MAKERS: dict[str, tuple[str, ...]] = {
    "FLIR's raw files and sequences: FLIR Thermal Studio or Research Studio exports them": (
        *(".seq", ".csq", ".fff", ".fcf", ".ats", ".ptw", ".sfmov"),
    ),
    "Fluke's: SmartView or Fluke Connect exports them": (".is2", ".is3"),
    "Testo's: IRSoft exports them": (".bmt", ".vmt"),
    "InfraTec's: IRBIS exports them": (".irb",),
    "InfiRay's: the camera's own program exports them": (".irg",),
    "Optris's: PIX Connect exports them": (".ravi",),
    "Workswell's sequences: CorePlayer or ThermoFormat exports them": (".wseq",),
}
_OF_SUFFIX = {suffix: maker for maker, suffixes in _MAKERS.items() for suffix in suffixes}


def foreign_sentences(paths: Sequence[Path], root: Path) -> list[str]:
    """A sentence for each maker whose thermal files lie in a folder and cannot be read.

    Args:
        root: The folder that names in the sentences are relative to.
    """
    found: dict[str, list[Path]] = {}
    for path in sorted(paths):
        if (maker := _OF_SUFFIX.get(path.suffix.lower())) is not None:
            found.setdefault(maker, []).append(path)
    return [
        f"{counted(len(mine), 'thermal file')} {agreeing(len(mine), 'was', 'were')} not read (first: "
        f"{mine[0].relative_to(root).as_posix()}). This format is {maker} as radiometric JPEGs or 16-bit TIFFs."
        for maker, mine in found.items()
    ]
