"""The image files of a transforms file's frames: those that it names, and those in thermal/ and thermal_raw/."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from thermosplat.datasets.image_files import list_images
from thermosplat.datasets.image_folders import thermal_folder
from thermosplat.datasets.image_names import NamedImages, files_in

_KEYS = {"rgb": "file_path", "thermal": "thermal_file_path"}


class FrameImages(NamedTuple):
    """Files of a frame; `values` are radiometric ones beside the thermal image, or the thermal image itself."""

    rgb: Path | None
    thermal: Path | None
    values: Path | None


def image_name(root: Path, entry: dict[str, Any]) -> PurePosixPath:
    """The image by which a frame is called; below the capture's folder if it lies there, so that folders can pair."""
    stated = PurePosixPath(str(entry.get("file_path") or entry.get("thermal_file_path")))
    folder = root.resolve()
    return stated.relative_to(folder) if stated.is_relative_to(folder) else stated


class TransformsImages:
    """Finds the files of frames, and keeps account of those that are named and do not exist.

    Args:
        root: The capture's folder.
        path: Its transforms file.
        names: Its frames, by `image_name`.
    """

    def __init__(self, root: Path, path: Path, names: Sequence[PurePosixPath]) -> None:
        self.not_found: dict[str, Path] = {}
        """By modality, the first file that is named and does not exist."""
        self._root, self._path = root, path
        self._names = NamedImages(path.name, [(name, None) for name in names])
        self._thermal, self._raw = (files_in(at, by_stem=True) for at in (thermal_folder(root), root / "thermal_raw"))
        self._without: list[PurePosixPath] = []
        self._lost: dict[str, list[Path]] = {"rgb": [], "thermal": []}
        self._replaced = 0

    def find(self, name: PurePosixPath, entry: dict[str, Any]) -> FrameImages | None:
        """The files of a frame, or None if there are none.

        Args:
            name: Its `image_name`.
            entry: What the transforms file says of it.

        Raises:
            UserError: Several images have one stem, and nothing tells which of them belong together.
        """
        named = {modality: self._named(entry.get(key)) for modality, key in _KEYS.items()}
        rgb, values = named["rgb"], self._of_name(self._raw, name)
        thermal = named["thermal"] or self._of_name(self._thermal, name) or values
        lost = {
            modality: self._root / entry[key]
            for modality, key in _KEYS.items()
            if entry.get(key) and named[modality] is None
        }
        self.not_found = lost | self.not_found
        if rgb is None and thermal is None:
            self._without.append(name)
            return None
        for modality, path in lost.items():
            self._lost[modality].append(path)
        self._replaced += "thermal" in lost and thermal is not None
        return FrameImages(None if rgb == thermal else rgb, thermal, values)

    def notes(self) -> list[str]:
        """What was named and not found, one line for each kind of file."""
        total, file = len(self._names), self._path.name
        notes = []
        if self._without:
            notes.append(
                f"{len(self._without)} of {total} frames of {file} have no file and were left out "
                f"(first: {self._without[0]})."
            )
        for modality, key in _KEYS.items():
            if lost := self._lost[modality]:
                notes.append(f"{key} of {len(lost)} of {total} frames of {file} names no file (first: {lost[0]}).")
        if self._replaced:
            notes[-1] += f" {self._replaced} of them have a thermal image of their own name, which was taken."
        return notes

    def _named(self, stated: Any) -> Path | None:
        """The file that a frame names, with or without its ending."""
        if not stated:
            return None
        path = self._root / stated
        if path.is_file():
            return path
        return next((file for file in list_images(path.parent) if file.stem == path.name), None)

    def _of_name(self, files: NamedImages[Path], name: PurePosixPath) -> Path | None:
        """The file of a frame in another folder."""
        found = files.find(name, self._names)
        return None if found is None else files[found]
