"""From what the cameras wrote to the images of a capture: photographs as they are, thermal files as values."""

import shutil
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from thermosplat.datasets.images.image_files import JPEG_SUFFIXES, read_image
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder, FrameRow
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.importing.flir_files import read_flir
from thermosplat.prepare.importing.found_files import LEAST_PHOTOGRAPHS, find_files
from thermosplat.prepare.importing.import_options import ImportOptions
from thermosplat.prepare.importing.source_files import SourceFile
from thermosplat.prepare.importing.thermal_images import import_thermal
from thermosplat.prepare.progress import tracked
from thermosplat.prepare.steps import StepReport, run_step
from thermosplat.prepare.whole_files import link_whole, write_jpeg
from thermosplat.regular_files import files_below
from thermosplat.runs.atomic_writes import sweep, write_bytes
from thermosplat.spectra import label

_RTK_FIXED = 50
"""What DJI writes for a position to some centimetres."""


_LONGEST_STEM = 200
"""Bytes."""


def import_files(folder: Path | None, capture: CaptureFolder, options: ImportOptions | None = None) -> StepReport:
    """Find photographs and thermal files, and write ``images/`` and ``frames.csv``.

    Args:
        folder: Where to look, at any depth; None if the options name the folder of every spectrum.
        capture: The capture to make. Images of an import that was interrupted are kept.

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
    for path in (capture.frames_csv, capture.pairs_csv, capture.thermal_parameters):
        path.unlink(missing_ok=True)


def _import(folder: Path | None, capture: CaptureFolder, options: ImportOptions) -> list[str]:
    groups, sentences = find_files(folder, capture, options)
    for spectrum in groups.files:
        sweep(capture.images(spectrum))
    rows: list[FrameRow] = []
    for spectrum, files in groups.files.items():
        names = _names(files)
        if spectrum == OTHER:
            found, said = import_thermal(
                files, names, capture, options.thermal, skip_unreadable=options.skip_unreadable
            )
            sentences += said
        else:
            found = [
                _photograph(capture, spectrum, file, name)
                for file, name in _shown(list(zip(files, names)), f"{label(spectrum)} images")
            ]
        rows += found
    if LEADING not in groups.files:  # of FLIR files alone
        photographs, said = _embedded(capture, groups.files[OTHER], rows)
        rows, sentences = [*photographs, *rows], [*sentences, *said]
    sentences = [_counted(rows), *sentences, *_further(rows), *_placed(rows), *_orientation(rows)]
    capture.write_frames(rows)
    return sentences


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
    """Bring one photograph to its place, unchanged; frames of videos, and what has to be turned, become JPEGs."""
    ending = ".jpg" if file.path.suffix.lower() in JPEG_SUFFIXES else file.path.suffix.lower()
    made = file.frame is not None or file.turn != 0
    target = capture.images(spectrum) / f"{name}{'.jpg' if made else ending}"
    if made:
        if not target.exists():
            write_jpeg(target, file.read())
    elif not target.exists() or target.stat().st_size != file.path.stat().st_size:
        link_whole(file.path, target)
    width, height = (file.height, file.width) if file.turn else (file.width, file.height)
    return file.row(spectrum, target.name, width, height)


def _embedded(
    capture: CaptureFolder, files: Sequence[SourceFile], thermal: Sequence[FrameRow]
) -> tuple[list[FrameRow], list[str]]:
    """The photographs inside radiometric files, under the names of their thermal images, and which have none."""
    rows, without = [], []
    by_source = {file.source: file for file in files}
    for row in _shown(list(thermal), "embedded photographs"):
        file = by_source[row.source]
        content = read_flir(file.path).photograph
        if content is None:
            without.append(file.name)
            continue
        ending = ".jpg" if content.startswith(b"\xff\xd8") else ".png"
        target = capture.images(LEADING) / f"{PurePosixPath(row.file).stem}{ending}"
        write_bytes(target, content)
        height, width = read_image(target).shape[:2]
        photograph = file.row(LEADING, target.name, width, height)
        rows.append(replace(photograph, focal_length_mm=None, focal_length_35mm=None))  # EXIF has the thermal lens's
    if len(rows) < LEAST_PHOTOGRAPHS:
        raise UserError(
            f"{len(rows)} of {counted(len(thermal), 'radiometric file')} {agreeing(len(rows), 'has', 'have')} a "
            f"photograph inside (first without: {without[0]}); a scene needs at least {LEAST_PHOTOGRAPHS}.",
            "Switch on that the camera saves the photograph, or name the folder of the photographs: --rgb DIR "
            "--thermal DIR",
        )
    if not without:
        return rows, []
    count = f"{len(without)} of {counted(len(thermal), 'radiometric file')}"
    return rows, [f"{count} {agreeing(len(without), 'has', 'have')} no photograph inside (first: {without[0]})."]


def _further(rows: Sequence[FrameRow]) -> list[str]:
    """How many images of each further spectrum have the name of a photograph, whose camera they take."""
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


def _placed(rows: Sequence[FrameRow]) -> list[str]:
    """How many images have a position, and whether RTK was lost."""
    parts, lost = [], 0
    for spectrum in dict.fromkeys(row.spectrum for row in rows):
        group = [row for row in rows if row.spectrum == spectrum]
        placed = sum(row.latitude is not None for row in group)
        if placed:
            parts.append(f"{placed} of {counted(len(group), f'{label(spectrum)} image')}")
        flags = [row.rtk_flag for row in group if row.rtk_flag is not None]
        lost += sum(flag != _RTK_FIXED for flag in flags) if _RTK_FIXED in flags else 0
    if not parts:
        return []
    rtk = f" RTK was not fixed in {counted(lost, 'image')}." if lost else ""
    return [f"{' and '.join(parts)} have a GPS position.{rtk}"]


def _orientation(rows: Sequence[FrameRow]) -> list[str]:
    turned = [row for row in rows if row.orientation not in (None, 1)]
    if not turned:
        return []
    return [
        f"{counted(len(turned), 'image is', 'images are')} to be turned for display (EXIF, first: {turned[0].file}); "
        "pixels are used as they are stored, which is right for every step here."
    ]
