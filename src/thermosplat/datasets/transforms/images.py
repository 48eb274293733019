"""The image files of a transforms file's frames: those that it names, and those in the spectra's folders."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from thermosplat.datasets.images.image_files import list_images
from thermosplat.datasets.images.image_folders import spectrum_folder, values_folder
from thermosplat.datasets.images.image_names import NamedImages, files_in, folders_of
from thermosplat.datasets.images.masks import masks_by_spectrum
from thermosplat.spectra import Source, SpectrumConfig, label


class ImageFile(NamedTuple):
    """The file of one spectrum of a frame."""

    path: Path
    values: Path | None
    """Values of more bits beside it, or the image itself; None: there are none."""
    mask: Path | None
    """Which of its pixels count; None: all."""


def file_keys(spectra: Mapping[str, SpectrumConfig]) -> dict[str, str]:
    """Under which key a frame names its file of each spectrum: file_path, thermal_file_path, ..."""
    return {name: "file_path" if place == 0 else f"{name}_file_path" for place, name in enumerate(spectra)}


def mask_keys(spectra: Mapping[str, SpectrumConfig]) -> dict[str, str]:
    """Under which key a frame names the mask of each spectrum: mask_path, thermal_mask_path, ..."""
    return {name: "mask_path" if place == 0 else f"{name}_mask_path" for place, name in enumerate(spectra)}


def image_name(root: Path, entry: dict[str, Any], keys: Mapping[str, str]) -> PurePosixPath:
    """The image by which a frame is called; below the capture's folder if it lies there, so that folders can pair."""
    stated = PurePosixPath(str(next(entry[key] for key in keys.values() if entry.get(key))))
    folder = root.resolve()
    return stated.relative_to(folder) if stated.is_relative_to(folder) else stated


class TransformsImages:
    """Finds the files of frames, and keeps account of those that are named and do not exist.

    Args:
        root: The capture's folder.
        names: Its frames, by `image_name`.
    """

    def __init__(
        self, root: Path, path: Path, names: Sequence[PurePosixPath], spectra: Mapping[str, SpectrumConfig]
    ) -> None:
        self.not_found: dict[str, Path] = {}
        """By spectrum, the first file that is named and does not exist."""
        self._root, self._path = root, path
        self._keys = file_keys(spectra)
        folders = folders_of(spectra)
        self._names = NamedImages(path.name, [(name, None) for name in names], folders=folders)
        self._leading, *others = spectra

        def files(folder: Path, source: Source = "auto") -> NamedImages[Path]:
            return files_in(folder, source, by_stem=True, folders=folders)

        self._files = {name: files(spectrum_folder(root, name, spectra[name]), spectra[name].source) for name in others}
        self._values = {name: files(values_folder(root, name, spectra[name])) for name in others}
        self._masks, self._mask_keys = masks_by_spectrum(root, spectra), mask_keys(spectra)
        self._lost_masks: list[Path] = []
        self._without: list[PurePosixPath] = []
        self._lost: dict[str, list[Path]] = {name: [] for name in spectra}
        self._replaced = dict.fromkeys(spectra, 0)

    def find(self, name: PurePosixPath, entry: dict[str, Any]) -> dict[str, ImageFile] | None:
        """The files of a frame by spectrum, or None if there are none.

        Raises:
            UserError: Several images have one stem, and nothing tells which of them belong together.
        """
        named = {spectrum: self._named(entry.get(key)) for spectrum, key in self._keys.items()}
        files: dict[str, ImageFile] = {}
        for spectrum in self._keys:
            values = self._of_name(self._values, spectrum, name)
            path = named[spectrum] or self._of_name(self._files, spectrum, name) or values
            if path is not None:
                files[spectrum] = ImageFile(path, values, self._mask(spectrum, name, entry))
        lost = {
            spectrum: self._root / entry[key]
            for spectrum, key in self._keys.items()
            if entry.get(key) and named[spectrum] is None
        }
        self.not_found = lost | self.not_found
        if not files:
            self._without.append(name)
            return None
        for spectrum, path in lost.items():
            self._lost[spectrum].append(path)
            self._replaced[spectrum] += spectrum in files
        others = {file.path for spectrum, file in files.items() if spectrum != self._leading}
        return {
            spectrum: file for spectrum, file in files.items() if spectrum != self._leading or file.path not in others
        }

    def notes(self) -> list[str]:
        """What was named and not found, one line for each kind of file."""
        total, file = len(self._names), self._path.name
        notes = []
        if self._without:
            notes.append(
                f"{len(self._without)} of {total} frames of {file} have no file and were left out "
                f"(first: {self._without[0]})."
            )
        for spectrum, key in self._keys.items():
            if lost := self._lost[spectrum]:
                notes.append(f"{key} of {len(lost)} of {total} frames of {file} names no file (first: {lost[0]}).")
            if replaced := self._replaced[spectrum]:
                notes[-1] += f" {replaced} of them have a {label(spectrum)} image of their own name, which was taken."
        if lost := self._lost_masks:
            notes.append(
                f"{len(lost)} masks that {file} names do not exist (first: {lost[0]}): all pixels count there."
            )
        return notes

    def _mask(self, spectrum: str, name: PurePosixPath, entry: dict[str, Any]) -> Path | None:
        """The mask that a frame names, or that has its name."""
        stated = entry.get(self._mask_keys[spectrum])
        found = self._named(stated)
        if stated and found is None:
            self._lost_masks.append(self._root / stated)
        return found or self._masks[spectrum].get(name, self._names)

    def _named(self, stated: Any) -> Path | None:
        """The file that a frame names, with or without its ending."""
        if not stated:
            return None
        path = self._root / stated
        if os.path.isfile(path):  # False also for a name that is too long
            return path
        return next((file for file in list_images(path.parent) if file.stem == path.name), None)

    def _of_name(self, files: Mapping[str, NamedImages[Path]], spectrum: str, name: PurePosixPath) -> Path | None:
        """The file of a frame in a spectrum's own folder."""
        return files[spectrum].get(name, self._names) if spectrum in files else None
