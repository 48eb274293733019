"""What a rendered capture knows of its held-out views beyond their images: depth per spectrum, and labelled regions.

``ground_truth/<stem>.npz`` beside the images, each array [H, W] in the pixels of the frame's images (all spectra share
a camera there, without lens distortion):

    depth_<spectrum>   z-depth of the surface that a spectrum sees [world units]; 0: none (sky). At least one.
    label              which kind of hard case the pixel belongs to, a key of ``LABELS``
"""

import io
import lzma
import math
import struct
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.errors import UserError

FOLDER = "ground_truth"
LABELS = {0: "unlabelled", 1: "glass", 2: "poster", 3: "hidden heat", 4: "plastic", 5: "specular"}
_LARGEST = 1 << 28
"""Most bytes of an array: depths in float64 of 33 megapixels."""
_DEPTH, _LABEL = "depth_", "label"
_REMEDY = f"Make it anew, or move {FOLDER}/ away to evaluate without it."


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Depths and labels at the size of a frame's images.

    Args:
        depths: Depth by spectrum, float32 [H, W] [world units]; 0 where there is no surface.
        label: [H, W] integers, keys of ``LABELS``.
    """

    depths: dict[str, NDArray[np.float32]]
    label: NDArray[np.integer[Any]]


def read_ground_truth(capture: Capture, frame: Frame) -> GroundTruth | None:
    """Ground truth of a frame, resampled to the size of its images (nearest pixel, by the pixels' centres).

    Returns:
        None where the capture has none for it, or where its views do not share a camera.

    Raises:
        UserError: The file is damaged, lacks an array, or has another aspect than the images or an unknown label.
    """
    if len(frame.shared_cameras) != 1:
        return None
    view = next(iter(frame.views.values()))
    path = capture.root / FOLDER / f"{view.name}.npz"
    if not path.is_file():
        return None
    arrays = _arrays(path, [f"{_DEPTH}{name}" for name in capture.spectra])
    size = view.camera.height, view.camera.width
    for name, array in arrays.items():
        # a size divided by --data-factor is rounded to whole pixels
        if abs(array.shape[0] / size[0] / (array.shape[1] / size[1]) - 1) > 1 / min(size):
            raise UserError(
                f"{path}: {name} has shape {list(array.shape)}, its images {list(size)}, another aspect.",
                f"Ground truth lies in the pixels of the images. {_REMEDY}",
            )
    if unknown := set(np.unique(arrays["label"]).tolist()) - LABELS.keys():
        raise UserError(f"{path}: label has {sorted(unknown)}, known are {sorted(LABELS)}.", _REMEDY)
    label = _nearest(arrays.pop(_LABEL), *size)
    depths = {name.removeprefix(_DEPTH): _nearest(array, *size).astype(np.float32) for name, array in arrays.items()}
    return GroundTruth(depths, label)


def check_ground_truth(capture: Capture) -> None:
    """Read the ground truth of all held-out frames, so that what is wrong with it is told before training.

    Raises:
        UserError: As ``read_ground_truth``.
    """
    for frame in capture.test:
        read_ground_truth(capture, frame)


def _arrays(path: Path, depths: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The labels and those of the depths that a file has, whatever their sizes."""
    wanted = f"Expected a NumPy archive (.npz) with the arrays {_LABEL} and {' or '.join(depths)}"
    try:
        held = _unpacked(path, (*depths, _LABEL))
    except UserError:
        raise
    except _DAMAGE as error:
        size = f"{path.stat().st_size:,} bytes"
        raise UserError(f"{path} is damaged or of another kind ({size}). {wanted}.", _REMEDY) from error
    if _LABEL not in held or len(held) < 2:
        found = f"{', '.join(held)} alone" if held else "none of its arrays"
        raise UserError(f"{path} holds {found}. {wanted}.", _REMEDY)
    for name, array in held.items():
        if array.dtype.kind not in "biuf" or array.ndim != 2 or array.size == 0:
            found = f"{array.dtype} of shape {list(array.shape)}"
            raise UserError(f"{path}: {name} holds {found}, expected numbers [H, W].", _REMEDY)
    return held


_DAMAGE = (
    *(OSError, ValueError, EOFError, MemoryError, RuntimeError, NotImplementedError, KeyError, SyntaxError),
    *(OverflowError, TypeError, RecursionError, struct.error, zipfile.BadZipFile, zlib.error, lzma.LZMAError),
)
"""What ``zipfile`` and NumPy raise for archives that are damaged, encrypted, or no archives."""


def _unpacked(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Those of the arrays that an archive has; none is unpacked that claims to be larger than it may be.

    The size that the archive states is what ``zipfile`` unpacks at most, and the size in the array's own header is
    compared with it before memory is taken.
    """
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        held = {entry.filename: entry for entry in archive.infolist()}
        for name in names:
            entry = held.get(f"{name}.npy")
            if entry is None:
                continue
            if entry.file_size > _LARGEST:
                raise UserError(
                    f"{path}: {name} would unpack to {entry.file_size:,} bytes; {_LARGEST:,} are possible.", _REMEDY
                )
            with archive.open(entry) as packed:
                content = io.BytesIO(packed.read())
            version = np.lib.format.read_magic(content)
            read_header = (
                np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            )
            shape, _, dtype = read_header(content)
            stated = math.prod(shape) * dtype.itemsize
            if dtype.hasobject or stated != len(content.getbuffer()) - content.tell():
                raise ValueError("objects, or another size than the header's")
            content.seek(0)
            arrays[name] = np.load(content, allow_pickle=False)
    return arrays


def _nearest(array: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """The pixel that holds each new pixel's centre: depths and labels have no averages across an edge."""
    rows = ((np.arange(height) + 0.5) * (array.shape[0] / height)).astype(int)
    columns = ((np.arange(width) + 0.5) * (array.shape[1] / width)).astype(int)
    return array[rows[:, None], columns]
