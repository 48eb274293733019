"""Images of a capture that is larger than memory, as bytes on the disk: each is decoded and undistorted once.

The files lie in a folder of the run. Their names say what they were made of, so that a resumed run finds its own again,
and nothing is taken for what it is not. What cannot be kept is made again when it is needed.
"""

import contextlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.runs.atomic_writes import NotWrittenError, write_atomically
from thermosplat.runs.written_files import KEPT_PIXELS


class PixelCache:
    """Arrays on the disk; none are kept until a folder is named."""

    def __init__(self) -> None:
        self.folder: Path | None = None

    def open(self, folder: Path, keys: Collection[str]) -> None:
        """Keep arrays in a folder from now on.

        Args:
            folder: The folder; it exists. Files of other keys in it, which older settings left, are deleted.
            keys: The keys there will be.
        """
        for file in folder.iterdir():
            if KEPT_PIXELS.fullmatch(file.name) and file.name.partition(".")[0] not in keys:
                file.unlink(missing_ok=True)
        self.folder = folder

    def close(self) -> None:
        """Keep nothing any more, and delete what was kept."""
        folder, self.folder = self.folder, None
        if folder is None:
            return
        with contextlib.suppress(OSError):  # somebody else has deleted it
            for file in folder.iterdir():
                if KEPT_PIXELS.fullmatch(file.name):
                    file.unlink(missing_ok=True)
            folder.rmdir()

    def load(self, key: str, part: str) -> NDArray[Any] | None:
        """An array that was kept; None where there is none, or what is left of one."""
        if self.folder is None:
            return None
        try:
            return np.load(self._path(self.folder, key, part), allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return None

    def has(self, key: str, part: str) -> bool:
        """Whether an array was kept."""
        return self.folder is not None and self._path(self.folder, key, part).is_file()

    def keep(self, key: str, part: str, array: NDArray[Any]) -> None:
        """Keep an array, if it can be written."""
        if self.folder is None or not self.folder.is_dir():  # the result folder may have been moved away
            return

        def write(path: Path) -> None:
            with path.open("wb") as file:
                np.save(file, array, allow_pickle=False)

        with contextlib.suppress(NotWrittenError):
            write_atomically(self._path(self.folder, key, part), write)

    @staticmethod
    def _path(folder: Path, key: str, part: str) -> Path:
        return folder / f"{key}.{part}.npy"
