"""Captures from folders. `load_capture` looks at a folder, tells its layout and reads it into memory."""

import os
from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

from thermosplat.config import ImageSize, LensUse, TrainConfig
from thermosplat.config.checks import check_text
from thermosplat.config.values import shortened
from thermosplat.datasets.assemble import assemble
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.datasets.geo_file import read_geo
from thermosplat.datasets.ground_truth import check_ground_truth
from thermosplat.datasets.image_size import TrainedSize
from thermosplat.datasets.layouts import list_capture
from thermosplat.errors import UserError
from thermosplat.spectra import DEFAULT_SPECTRA, SpectrumConfig

__all__ = ["SAMPLE", "Capture", "Frame", "View", "capture_of", "load_capture"]

SAMPLE = "sample"
"""Name by which `load_capture` finds the small capture that comes with the package."""
_LONGEST_PATH = 4096
"""Characters of a path on Linux; a longer one is shown shortened."""


def capture_of(config: TrainConfig) -> Capture:
    """Read the capture that a configuration names, as it asks for.

    Args:
        config: The configuration.

    Raises:
        UserError: As ``load_capture``.
    """
    return load_capture(
        config.data,
        data_factor=config.data_factor,
        image_size=config.image_size,
        test_every=config.test_every,
        spectra=config.spectra,
        lens=config.lens,
        image_memory=config.image_memory,
    )


def load_capture(
    data: str | Path,
    *,
    data_factor: int = 1,
    image_size: ImageSize = "auto",
    test_every: int = 8,
    spectra: Mapping[str, SpectrumConfig] = DEFAULT_SPECTRA,
    lens: LensUse = "undistort",
    image_memory: float | None = None,
) -> Capture:
    """Read a capture, whatever its layout (docs/data-layouts.md).

    Args:
        data: Folder of the capture, or "sample" for the one in the package (a folder of that name is "./sample").
        data_factor: Divide the images' width and height by this.
        image_size: Longest side of the images [px]; "auto": 1,600, or any with a factor.
        test_every: Every n-th frame is held out, where the folders do not say which are.
        spectra: The spectra to look for, and how the images of each are read. RGB and thermal by default.
        lens: "undistort" resamples images of distorted lenses to pinhole images; "direct" leaves them as they were
            taken, and their cameras have a lens.
        image_memory: Most memory that images take [GB]; those of a larger capture stay on the disk and are read when
            they are needed. None: half of the host's memory.

    Raises:
        UserError: The folder is missing, no known layout, or something in it cannot be used.
    """
    if str(data) == SAMPLE:
        root, name = Path(str(files("thermosplat").joinpath("sample"))), SAMPLE
    else:
        root = Path(os.path.expanduser(data))  # pathlib's own fails where there is no such user
        name = ""
    if not str(data):
        raise UserError("No capture given.", "Name a folder, or take the one in the package: thermosplat-train sample")
    if not os.path.isdir(root):  # False also for a name that is too long
        what = "is a file, not a folder" if os.path.exists(root) else "does not exist"
        shown = str(root) if len(str(root)) <= _LONGEST_PATH else shortened(str(root))
        raise UserError(
            f"The capture {shown} {what}.",
            "Give the folder that holds rgb/ or images/; for a first try: thermosplat-train sample",
        )
    check_text(root.resolve(), "The capture's folder")
    try:
        listing = list_capture(root, spectra)
        name = name or root.resolve().name
        capture = assemble(
            root,
            name,
            listing,
            size=TrainedSize(data_factor, image_size),
            test_every=test_every,
            spectra=spectra,
            image_memory=image_memory,
            lens=lens,
        )
        check_ground_truth(capture)
        capture = _located(capture)
    except OSError as error:
        where = error.filename or root
        raise UserError(
            f"Cannot read {where}: {error.strerror or error}.", "May you read it, and is the disk there?"
        ) from error
    return capture


def _located(capture: Capture) -> Capture:
    """The capture with what geo.json in its folder says, which may be another program's and then counts for nothing."""
    try:
        return replace(capture, geo=read_geo(capture.root))
    except UserError as error:
        note = f"{error.message} The capture counts as one without a place on the Earth."
        return replace(capture, notes=(*capture.notes, note))
