"""The thermal images of a capture in memory, of one size."""

from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import OTHER, CaptureFolder
from thermosplat.prepare.progress import progress_bar


def thermal_images(
    capture: CaptureFolder, names: Sequence[str], listed_in: str = "pairs.csv"
) -> list[NDArray[np.generic]]:
    """Read thermal images.

    Raises:
        UserError: One cannot be read, or they have several sizes.
    """
    read = []
    with progress_bar("thermal images", len(names)) as advance:
        for name in names:
            path = capture.images(OTHER) / name
            try:
                image = read_image(path)
            except UserError as error:
                raise UserError(
                    f"{path} is listed in {listed_in} and cannot be read. {error.message}",
                    f"Import and pair again: thermosplat-prepare pair {capture.root}",
                ) from error
            read.append(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
            advance(1)
    sizes = Counter(image.shape[:2] for image in read)
    if len(sizes) > 1:
        stated = ", ".join(f"{count} of {width}x{height} px" for (height, width), count in sizes.most_common())
        raise UserError(
            f"The thermal images of {capture.root} have several sizes: {stated}. One camera has one size.",
            f"Prepare a capture for each camera, or leave those of the other size out of {listed_in}.",
        )
    return read
