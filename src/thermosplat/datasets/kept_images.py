"""Where the images of a capture that stays on the disk are kept while it is trained on."""

import shutil
from pathlib import Path

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.large_captures import GIGABYTE
from thermosplat.runs.atomic_writes import plain_folder
from thermosplat.runs.written_files import PIXELS

_SHARE_OF_DISK = 0.8
"""Of the free space; checkpoints and pictures need the rest."""


def keep_images(capture: Capture, result_folder: Path) -> list[str]:
    """Keep what is decoded and undistorted in a result folder from now on, if its disk has room.

    Args:
        capture: The capture; nothing is done for one that is in memory.

    Returns:
        What to tell of it, a line each.
    """
    if capture.on_disk is None:
        return []
    folder = plain_folder(result_folder, PIXELS)
    frames = (*capture.train, *capture.test)
    stored = {view.stored.key: view.stored for frame in frames for view in frame.views.values() if view.stored}
    capture.on_disk.cache.open(folder, stored.keys())
    needed = sum(pixels.kept_bytes for pixels in stored.values())
    there = sum(file.stat().st_size for file in folder.iterdir())
    if needed - there > _SHARE_OF_DISK * shutil.disk_usage(folder).free:
        capture.on_disk.cache.close()
        return [
            f"The disk of {folder.parent} has no room for the {needed / GIGABYTE:,.3g} GB of undistorted images: each "
            "is decoded again whenever it is needed."
        ]
    return [f"Undistorted images are kept in {folder} until the training ends: up to {needed / GIGABYTE:,.3g} GB."]


def forget_images(capture: Capture) -> None:
    """Delete what ``keep_images`` has kept: nobody will train on it any more."""
    if capture.on_disk is not None:
        capture.on_disk.cache.close()
