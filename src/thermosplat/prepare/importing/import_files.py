"""From what the cameras wrote to the images of a capture: photographs as they are, thermal files as values."""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from thermosplat.datasets.images.image_files import JPEG_SUFFIXES, read_image
from thermosplat.datasets.images.unread_formats import unread_note
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder, FrameRow
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.importing.camera_groups import Groups, group_files, one_camera, prefer_values
from thermosplat.prepare.importing.flir_files import read_flir
from thermosplat.prepare.importing.source_files import SourceFile, SourceFolder, read_folder
from thermosplat.prepare.importing.thermal_images import ThermalOptions, import_thermal
from thermosplat.prepare.progress import tracked
from thermosplat.prepare.steps import StepReport, run_step
from thermosplat.prepare.whole_files import link_whole, write_jpeg
from thermosplat.regular_files import files_below
from thermosplat.runs.atomic_writes import sweep, write_bytes
from thermosplat.spectra import label

LEAST_PHOTOGRAPHS = 5
"""Photographs without which no scene can be reconstructed; a good one has 30 or more."""


@dataclass(frozen=True)
class ImportOptions:
    """What the user says about the files.

    Args:
        folders: Folder of each spectrum that is not to be found by itself.
        every: Of a video every so many frames are taken.
        take_most: Of several cameras or sizes in one spectrum take the most frequent.
        skip_unreadable: Leave out files that cannot be read.
        thermal: How thermal files are turned into values.
    """

    folders: Mapping[str, str] = field(default_factory=dict)
    every: int = 15
    take_most: bool = False
    skip_unreadable: bool = False
    thermal: ThermalOptions = field(default_factory=ThermalOptions)

    def settings(self) -> dict[str, Any]:
        """As plain values, for the step's file."""
        return {
            "folders": dict(self.folders),
            "every": self.every,
            "take_most": self.take_most,
            "skip_unreadable": self.skip_unreadable,
            "thermal": self.thermal.settings(),
        }


_LONGEST_STEM = 200
"""Bytes."""


def import_files(folder: Path | None, capture: CaptureFolder, options: ImportOptions | None = None) -> StepReport:
    """Find photographs and thermal files, and write ``images/`` and ``frames.csv``.

    Args:
        folder: Where to look, at any depth; None if the options name the folder of every spectrum.
        capture: The capture to make. Images of an import that was interrupted are kept.
        options: What the user says about the files.

    Returns:
        What was found.

    Raises:
        UserError: The files are not what a capture can be made of.
    """
    options = options or ImportOptions()
    _check_place(capture)
    _refuse_our_own(folder)
    roots = [Path(path) for path in options.folders.values()] if options.folders or folder is None else [folder]
    return run_step(
        capture,
        "import",
        lambda: _import(folder, capture, options),
        settings={"folder": str(folder and folder.resolve()), **options.settings()},
        inputs=[path for root in roots for path in _files_below(root, capture)],
        outputs=[capture.frames_csv],
        restart=lambda: _clear(capture),
    )


def _check_place(capture: CaptureFolder) -> None:
    """Refuse to write among files that are not ours."""
    if capture.root.is_dir() and not capture.prepared.is_dir() and any(capture.root.iterdir()):
        raise UserError(
            f"{capture.root} holds other files, and no capture that thermosplat-prepare began.",
            "Name a folder that is not there yet: --out CAPTURE",
        )


def _refuse_our_own(folder: Path | None) -> None:
    """Refuse captures that are being prepared and result folders in the place of the cameras' files."""
    if folder is not None and (folder / "prepared").is_dir():
        raise UserError(
            f"{folder} is a capture that thermosplat-prepare made, not a folder of cameras' files.",
            f"Go on with a step of it, such as thermosplat-prepare pair {folder}, or give the cameras' folder again.",
        )
    if folder is not None and (folder / "ckpts").is_dir():
        raise UserError(
            f"{folder} is the result folder of a training, not a folder of cameras' files.",
            "Give the folder that the cameras' files were copied to.",
        )


def _files_below(root: Path, capture: CaptureFolder) -> list[Path]:
    """The files that an import depends on; what it writes itself may lie among them."""
    written = capture.root.resolve()
    return [path for path in files_below(root) if written not in path.resolve().parents]


def _clear(capture: CaptureFolder) -> None:
    """Remove what an import with other settings or files left."""
    shutil.rmtree(capture.root / "images", ignore_errors=True)
    for path in (capture.frames_csv, capture.pairs_csv):
        path.unlink(missing_ok=True)


def _import(folder: Path | None, capture: CaptureFolder, options: ImportOptions) -> list[str]:
    groups, sentences = _find(folder, capture, options)
    for spectrum in groups.files:
        sweep(capture.images(spectrum))
    rows: list[FrameRow] = []
    for spectrum, files in groups.files.items():
        names = _names(files)
        if spectrum == OTHER:
            found, said = import_thermal(files, names, capture, options.thermal)
            sentences += said
        else:
            found = [
                _photograph(capture, spectrum, file, name)
                for file, name in _shown(list(zip(files, names)), f"{label(spectrum)} images")
            ]
        rows += found
    if LEADING not in groups.files:  # of FLIR files alone
        rows = [*_embedded(capture, groups.files[OTHER], rows), *rows]
    sentences = [_counted(rows), *sentences, *_further(rows), *_orientation(rows)]
    capture.write_frames(rows)
    return sentences


def _find(folder: Path | None, capture: CaptureFolder, options: ImportOptions) -> tuple[Groups, list[str]]:
    """The files by spectrum, each of one camera."""
    found: dict[str, Sequence[SourceFile]] = {}
    sentences: list[str] = []
    if options.folders:
        for spectrum, place in options.folders.items():
            found[spectrum] = _look(Path(place), capture, options, sentences).files
            if not found[spectrum]:
                raise _nothing(Path(place), f"{label(spectrum)} images")
    else:
        if folder is None:
            raise UserError("No folder given.", "Say where the files are: thermosplat-prepare FOLDER")
        content = _look(folder, capture, options, sentences)
        if not content.files:
            raise _nothing(folder, "photographs and thermal files", content.others)
        groups = group_files(content.files)
        sentences += groups.sentences
        found = {spectrum: files for spectrum, files in groups.files.items() if files}
        _check_both(folder, found)
    if OTHER in found:
        found[OTHER], said = prefer_values(found[OTHER])
        sentences += said
    for spectrum, files in found.items():
        found[spectrum], said = one_camera(label(spectrum), files, options.take_most)
        sentences += said
    photographs = len(found.get(LEADING, found.get(OTHER, ())))
    if photographs < LEAST_PHOTOGRAPHS:
        raise UserError(
            f"{counted(photographs, 'usable photograph was', 'usable photographs were')} found in "
            f"{folder or options.folders[LEADING]}; "
            f"a scene needs at least {LEAST_PHOTOGRAPHS}, from different places, and 30 or more to look good."
            f"{''.join(f' {sentence}' for sentence in sentences)}",
            "Take more (docs/capturing.md), or name the right folders: --rgb DIR --thermal DIR",
        )
    return Groups({spectrum: tuple(files) for spectrum, files in found.items()}), sentences


def _look(folder: Path, capture: CaptureFolder, options: ImportOptions, sentences: list[str]) -> SourceFolder:
    """All images of a folder; unreadable ones are an error, or left out and said."""
    content = read_folder(
        folder,
        every=options.every,
        skip=[capture.root],
        progress=lambda paths, count: tracked(paths, "looking at files", count),
    )
    unread = unread_note(folder)
    if unread is not None:
        sentences.append(unread)
    if content.unreadable:
        path, reason = content.unreadable[0]
        total = len(content.unreadable) + len(content.files)
        count = f"{len(content.unreadable)} of {counted(total, 'image')}"
        found = f"{count} in {folder} cannot be read (first: {path}: {reason})"
        if not options.skip_unreadable:
            raise UserError(f"{found}.", "Copy them from the camera again, or leave them out: --skip-unreadable")
        sentences.append(f"{found}; {agreeing(len(content.unreadable), 'it was', 'they were')} left out.")
    return content


def _check_both(folder: Path, found: Mapping[str, Sequence[SourceFile]]) -> None:
    """Refuse a folder with one spectrum only, except radiometric files that have photographs inside."""
    if OTHER not in found:
        first = found[LEADING][0]
        raise UserError(
            f"{folder} has {counted(len(found[LEADING]), 'photograph')} and no thermal files that could be told "
            "from them "
            f"(first: {first.name}).",
            "Name both folders: --rgb DIR --thermal DIR. For photographs alone: --rgb DIR",
        )
    if LEADING not in found:
        files = found[OTHER]
        if files[0].kind == "flir" and read_flir(files[0].path).photograph is not None:
            return
        raise UserError(
            f"{folder} has {counted(len(files), 'thermal file')} and no photographs (first: {files[0].name}). "
            "The poses of the "
            "cameras are found on photographs, because thermal images have too little texture.",
            "Add the photographs of the same moments, or name their folder: --rgb DIR --thermal DIR",
        )


def _nothing(folder: Path, wanted: str, others: int = 0) -> UserError:
    inside = sorted(path.name + ("/" if path.is_dir() else "") for path in folder.iterdir()) if folder.is_dir() else []
    shown = ", ".join(inside[:8]) + (", ..." if len(inside) > 8 else "")
    files = f" and {counted(others, 'file that is no image', 'files that are no images')}" if others else ""
    unread = unread_note(folder)
    return UserError(
        f"No {wanted} in {folder}. Found: {shown or 'nothing'}{files}.{'' if unread is None else f' {unread}'}",
        "Give the folder that the cameras' files were copied to; JPEG, PNG, TIFF and videos are read.",
    )


def _names(files: Sequence[SourceFile]) -> list[str]:
    """Names without endings in the capture: the files' stems, with their folders where stems are not unique."""
    for parts in (1, 2, 3, 99):
        names = []
        for file in files:
            path = PurePosixPath(file.name)
            stem = _plain("_".join([*path.parts[:-1], path.stem][-parts:]))
            names.append(stem if file.frame is None else f"{stem}_{file.frame:06d}")
        if len(set(names)) == len(names):
            return names
    return [f"{name}_{number}" for number, name in enumerate(names)]  # one stem with several endings


def _plain(stem: str) -> str:
    """A name that COLMAP's text files and every disk can hold: no blanks, no signs that are not printed, not too long.

    COLMAP separates names by blanks. A name has 255 bytes at most, and endings and numbers come after this one.
    """
    plain = "".join(sign if sign.isprintable() and not sign.isspace() else "_" for sign in stem)
    return plain.encode()[:_LONGEST_STEM].decode(errors="ignore")


def _shown(items: Sequence[Any], what: str) -> Iterable[Any]:
    return tracked(items, f"importing {what}", len(items))


def _photograph(capture: CaptureFolder, spectrum: str, file: SourceFile, name: str) -> FrameRow:
    """Bring one photograph to its place, unchanged; frames of videos become JPEGs."""
    ending = ".jpg" if file.path.suffix.lower() in JPEG_SUFFIXES else file.path.suffix.lower()
    target = capture.images(spectrum) / f"{name}{ending if file.frame is None else '.jpg'}"
    if file.frame is not None:
        if not target.exists():
            write_jpeg(target, file.read())
    elif not target.exists() or target.stat().st_size != file.path.stat().st_size:
        link_whole(file.path, target)
    return file.row(spectrum, target.name, file.width, file.height)


def _embedded(capture: CaptureFolder, files: Sequence[SourceFile], thermal: Sequence[FrameRow]) -> list[FrameRow]:
    """The photographs inside radiometric files, under the names of their thermal images."""
    rows = []
    for file, row in _shown(list(zip(files, thermal)), "embedded photographs"):
        content = read_flir(file.path).photograph
        if content is None:
            continue
        ending = ".jpg" if content.startswith(b"\xff\xd8") else ".png"
        target = capture.images(LEADING) / f"{PurePosixPath(row.file).stem}{ending}"
        write_bytes(target, content)
        height, width = read_image(target).shape[:2]
        photograph = file.row(LEADING, target.name, width, height)
        rows.append(replace(photograph, focal_length_mm=None, focal_length_35mm=None))  # EXIF has the thermal lens's
    return rows


def _further(rows: Sequence[FrameRow]) -> list[str]:
    """How many images of each further spectrum have the name of a photograph, whose camera they take.

    Raises:
        UserError: None of a spectrum has.
    """
    stems = {PurePosixPath(row.file).stem for row in rows if row.spectrum == LEADING}
    said = []
    for spectrum in dict.fromkeys(row.spectrum for row in rows if row.spectrum not in (LEADING, OTHER)):
        group = [row for row in rows if row.spectrum == spectrum]
        alike = sum(PurePosixPath(row.file).stem in stems for row in group)
        if not alike:
            raise UserError(
                f"None of the {len(group)} {label(spectrum)} images has the name of a photograph (first: "
                f"{group[0].source}). They take the camera of the photograph of the same name.",
                "Show the photographs' view in them and name them alike, or register them with COLMAP "
                "(docs/data-layouts.md).",
            )
        said.append(
            f"{alike} of {counted(len(group), f'{label(spectrum)} image')} {agreeing(alike, 'has', 'have')} the name "
            f"of a photograph and {agreeing(alike, 'takes its camera', 'take its camera')}: they must show its view."
        )
    return said


def _counted(rows: Sequence[FrameRow]) -> str:
    parts = []
    for spectrum in dict.fromkeys(row.spectrum for row in rows):
        group = [row for row in rows if row.spectrum == spectrum]
        parts.append(f"{counted(len(group), f'{label(spectrum)} image')} of {group[0].width}x{group[0].height} px")
    return f"{' and '.join(parts)}."


def _orientation(rows: Sequence[FrameRow]) -> list[str]:
    turned = [row for row in rows if row.orientation not in (None, 1)]
    if not turned:
        return []
    return [
        f"{counted(len(turned), 'image is', 'images are')} to be turned for display (EXIF, first: {turned[0].file}); "
        "pixels are used as they are stored, which is right for every step here."
    ]
