"""The files that a capture is made of, by spectrum, each of one camera; or why there is no capture in a folder."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from thermosplat.datasets.images.unread_formats import unread_note
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.importing.camera_groups import Groups, group_files, one_camera, prefer_values
from thermosplat.prepare.importing.flir_files import has_photograph
from thermosplat.prepare.importing.import_options import ImportOptions
from thermosplat.prepare.importing.position_tables import with_tables
from thermosplat.prepare.importing.source_files import SourceFile, SourceFolder, read_folder
from thermosplat.prepare.progress import tracked
from thermosplat.spectra import label

LEAST_PHOTOGRAPHS = 5
"""Photographs without which no scene can be reconstructed; a good one has 30 or more."""


def find_files(folder: Path | None, capture: CaptureFolder, options: ImportOptions) -> tuple[Groups, list[str]]:
    """The files by spectrum, each of one camera."""
    found: dict[str, Sequence[SourceFile]] = {}
    sentences: list[str] = []
    if options.folders:
        for spectrum, place in options.folders.items():
            content = _look(Path(place), capture, options, sentences)
            found[spectrum] = content.files
            if not content.files:
                raise _nothing(Path(place), f"{label(spectrum)} images", content)
    else:
        if folder is None:
            raise UserError("No folder given.", "Say where the files are: thermosplat-prepare FOLDER")
        content = _look(folder, capture, options, sentences)
        if not content.files:
            raise _nothing(folder, "photographs and thermal files", content)
        groups = group_files(content.files)
        sentences += groups.sentences
        found = {spectrum: files for spectrum, files in groups.files.items() if files}
        _check_both(folder, found)
    if OTHER in found:
        found[OTHER], said = prefer_values(found[OTHER])
        sentences += said
    for spectrum, files in found.items():
        found[spectrum], said = one_camera(label(spectrum), files, options.take_most, options.turn_back)
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
    files, said = with_tables(content.files, folder)
    sentences += [*content.foreign, *said]
    return replace(content, files=tuple(files))


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
        if any(file.kind == "flir" and has_photograph(file.path) for file in files):
            return
        raise UserError(
            f"{folder} has {counted(len(files), 'thermal file')} and no photographs (first: {files[0].name}). "
            "The poses of the "
            "cameras are found on photographs, because thermal images have too little texture.",
            "Add the photographs of the same moments, or name their folder: --rgb DIR --thermal DIR",
        )


def _nothing(folder: Path, wanted: str, content: SourceFolder) -> UserError:
    if content.foreign:
        return UserError(
            f"No {wanted} in {folder} that can be read. {' '.join(content.foreign)}",
            "Export them, and give the folder of the exported files.",
        )
    inside = sorted(path.name + ("/" if path.is_dir() else "") for path in folder.iterdir()) if folder.is_dir() else []
    shown = ", ".join(inside[:8]) + (", ..." if len(inside) > 8 else "")
    others = content.others
    files = f" and {counted(others, 'file that is no image', 'files that are no images')}" if others else ""
    unread = unread_note(folder)
    return UserError(
        f"No {wanted} in {folder}. Found: {shown or 'nothing'}{files}.{'' if unread is None else f' {unread}'}",
        "Give the folder that the cameras' files were copied to; JPEG, PNG, TIFF and videos are read.",
    )
