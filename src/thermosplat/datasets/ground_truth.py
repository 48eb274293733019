"""What a rendered capture knows of its held-out views beyond their images: depth per spectrum, and labelled regions.

``ground_truth/<stem>.npz`` beside the images, each array [H, W] in the pixels of the frame's images (RGB and thermal
share a camera there, without lens distortion):

    depth_rgb, depth_thermal   z-depth of the surface that each spectrum sees [world units]; 0: none (sky)
    label                      which kind of hard case the pixel belongs to, a key of ``LABELS``
"""

import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.errors import UserError

FOLDER = "ground_truth"
LABELS = {0: "unlabelled", 1: "glass", 2: "poster", 3: "hidden heat", 4: "plastic", 5: "specular"}


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Depths and labels at the size of a frame's images.

    Args:
        depths: Depth by modality, float32 [H, W] [world units]; 0 where there is no surface.
        label: [H, W] integers, keys of ``LABELS``.
    """

    depths: dict[str, NDArray[np.float32]]
    label: NDArray[np.integer[Any]]


def read_ground_truth(capture: Capture, frame: Frame) -> GroundTruth | None:
    """Ground truth of a frame, resampled to the size of its images (nearest pixel, by the pixels' centres).

    Args:
        capture: The frame's capture.
        frame: The frame.

    Returns:
        None where the capture has none for it, or where its two views do not share a camera.

    Raises:
        UserError: The file is damaged, lacks an array, or has another aspect than the images or an unknown label.
    """
    view = frame.rgb or frame.thermal
    if view is None or (frame.rgb is not None and frame.thermal is not None and not frame.aligned):
        return None
    path = capture.root / FOLDER / f"{view.name}.npz"
    if not path.is_file():
        return None
    names = ("depth_rgb", "depth_thermal", "label")
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in names}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UserError(
            f"{path} does not hold the arrays {', '.join(names)}: {error}.",
            f"Restore it, or move {FOLDER}/ away to evaluate without it.",
        ) from error
    size = view.camera.height, view.camera.width
    for name, array in arrays.items():
        # a size divided by --data-factor is rounded to whole pixels
        if array.ndim != 2 or abs(array.shape[0] / size[0] / (array.shape[1] / size[1]) - 1) > 1 / min(size):
            raise UserError(
                f"{path}: {name} has shape {list(array.shape)}, its images {list(size)}, another aspect.",
                "Ground truth lies in the pixels of the images.",
            )
    if unknown := set(np.unique(arrays["label"]).tolist()) - LABELS.keys():
        raise UserError(f"{path}: label has {sorted(unknown)}, known are {sorted(LABELS)}.")
    depth_rgb, depth_thermal, label = (_nearest(arrays[name], *size) for name in names)
    depths = {"rgb": depth_rgb.astype(np.float32), "thermal": depth_thermal.astype(np.float32)}
    return GroundTruth(depths, label)


def _nearest(array: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """The pixel that holds each new pixel's centre: depths and labels have no averages across an edge."""
    rows = ((np.arange(height) + 0.5) * (array.shape[0] / height)).astype(int)
    columns = ((np.arange(width) + 0.5) * (array.shape[1] / width)).astype(int)
    return array[rows[:, None], columns]
