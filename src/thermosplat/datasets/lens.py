"""Calibrated cameras as the data states them, and how their images become pinhole images.

PINHOLE and SIMPLE_PINHOLE cameras are used as they are. Any other COLMAP model (nerfstudio's OPENCV included) is
replaced by the pinhole camera that COLMAP's own undistorter would choose, and its images are resampled to it; or its
images stay as they are, and the renderer projects through the lens.
"""

import functools
from dataclasses import dataclass, replace
from typing import Any

import cv2  # before pycolmap: imported the other way round, without torch, writing a PNG crashes (two zlibs)
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.datasets.cameras import Camera, LensCoefficients

PINHOLE_MODELS = frozenset({"PINHOLE", "SIMPLE_PINHOLE"})
RENDERED: dict[str, dict[str, tuple[str, ...]]] = {
    "pinhole": {
        "SIMPLE_RADIAL": ("k1",),
        "RADIAL": ("k1", "k2"),
        "OPENCV": ("k1", "k2", "p1", "p2"),
        "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    },
    "fisheye": {
        "SIMPLE_FISHEYE": (),
        "FISHEYE": (),
        "SIMPLE_RADIAL_FISHEYE": ("k1",),
        "RADIAL_FISHEYE": ("k1", "k2"),
        "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    },
}
"""COLMAP's models that the renderer projects through, by its ``camera_model``, the one with most parameters last: each
with its parameters behind the intrinsics (COLMAP's sensor/models.h)."""
_NAMES = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
"""Of ``LensCoefficients``."""
CUT_PANORAMAS = (
    "Cut them into pinhole images first: COLMAP's example panorama_sfm.py does it and registers them, or "
    "ns-process-data images --camera-type equirectangular."
)
"""What to do about images of 360 degrees."""
KEPT_MAPS = 8
"""Lenses whose maps are kept, for the next images."""
_ROWS = 256
"""Rows of an image that are undistorted at once."""
_ASPECT_TOLERANCE = 0.01
"""Share by which a file's aspect may differ from its camera's: RGBT-Scenes has 633x476 beside 640x480."""


@dataclass(frozen=True)
class Lens:
    """A calibrated camera: a COLMAP camera model with its parameters and the image size they refer to.

    Args:
        params: Its parameters in COLMAP's order; lengths in [px], pixel centres at half-integers.
        width: Image width at calibration [px].
        height: Image height at calibration [px].
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    @classmethod
    def from_colmap(cls, camera: pycolmap.Camera) -> "Lens":
        """The lens of a camera in a COLMAP model."""
        return cls(camera.model.name, tuple(float(p) for p in camera.params), camera.width, camera.height)

    @property
    def distorted(self) -> bool:
        """Images have to be resampled before a pinhole camera describes them."""
        return self.model not in PINHOLE_MODELS

    def focal_lengths(self) -> tuple[float, ...]:
        """One or two focal lengths [px]; none of images of 360 degrees."""
        indices = pycolmap.Camera(model=self.model).focal_length_idxs()  # whatever size a file states
        return tuple(self.params[index] for index in indices)

    def fits(self, width: int, height: int) -> bool:
        """An image of this size [px] can be this camera's, perhaps scaled: the aspects agree within 1% or a pixel."""
        expected = self.height * width / self.width
        return abs(expected - height) <= max(1.0, _ASPECT_TOLERANCE * expected)

    def colmap_camera(self) -> pycolmap.Camera:
        """The same camera as a pycolmap object."""
        return pycolmap.Camera(model=self.model, params=list(self.params), width=self.width, height=self.height)


@dataclass(frozen=True, eq=False)
class Rectification:
    """A pinhole camera, and the resampling that brings a file's image to it.

    Args:
        maps: [height, width, 2] float32 position in the file's image for each pixel, counted from the first pixel's
            centre as `cv2.remap` does; None where the image is already a pinhole image.
    """

    camera: Camera
    maps: NDArray[np.float32] | None

    def apply(self, image: NDArray[Any], *, exact: bool = False) -> NDArray[Any]:
        """The image as the pinhole camera sees it: bilinear, or by the nearest pixel where there is no mean of two."""
        if self.maps is None:
            return image
        how = cv2.INTER_NEAREST if exact else cv2.INTER_LINEAR
        return cv2.remap(image, self.maps, None, how, borderMode=cv2.BORDER_REPLICATE)


@functools.lru_cache(maxsize=64)
def rectified_camera(lens: Lens, width: int, height: int) -> Camera:
    """The pinhole camera that the images of a lens are brought to.

    Args:
        lens: The files' camera; may be calibrated at another size, then the intrinsics are scaled.
        width: Width of the files' images [px].
        height: Height of the files' images [px].
    """
    source = lens.colmap_camera()
    if not lens.distorted:
        return _pinhole(source).resized(width, height)
    ideal = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), source)
    size = max(1, round(ideal.width * (width / lens.width))), max(1, round(ideal.height * (height / lens.height)))
    return _pinhole(ideal).resized(*size)


@functools.lru_cache(maxsize=KEPT_MAPS)
def rectification(lens: Lens, width: int, height: int) -> Rectification:
    """How an image file of a given size becomes a pinhole image.

    Args:
        width: Width of the file's image [px].
        height: Height of the file's image [px].
    """
    camera = rectified_camera(lens, width, height)
    if not lens.distorted:
        return Rectification(camera, None)
    maps = np.empty((camera.height, camera.width, 2), np.float32)
    for start in range(0, camera.height, _ROWS):  # rays take several times the memory of the maps
        rows = np.arange(start, min(start + _ROWS, camera.height))
        places = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, rows + 0.5), axis=-1)
        maps[start : start + _ROWS] = positions_in_file(lens, width, height, camera, places) - 0.5
    return Rectification(camera, maps)


def positions_in_file(
    lens: Lens, width: int, height: int, camera: Camera, places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where places of the pinhole image lie in a file's image.

    Args:
        width: Width of the file's image [px].
        height: Height of the file's image [px].
        places: x and y in the pinhole image [px], shape [..., 2].

    Returns:
        x and y in the file's image [px], shape [..., 2].
    """
    slopes = (places - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    rays = np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1)
    seen = lens.colmap_camera().img_from_cam(rays.reshape(-1, 3))
    return (seen * (width / lens.width, height / lens.height)).reshape(places.shape)


def camera_through_lens(lens: Lens, width: int, height: int) -> Camera | None:
    """The camera of an image file as it was taken.

    Args:
        lens: The file's camera; may be calibrated at another size, then the intrinsics are scaled.
        width: Width of the file's image [px].
        height: Height of the file's image [px].

    Returns:
        The camera; None if the renderer does not know its model.
    """
    source = lens.colmap_camera()
    if not lens.distorted:
        return _pinhole(source).resized(width, height)
    model = next((model for model, known in RENDERED.items() if lens.model in known), None)
    if model is None:
        return None
    names = RENDERED[model][lens.model]
    found = dict(zip(names, lens.params[len(lens.params) - len(names) :], strict=True))
    k1, k2, k3, k4, k5, k6, p1, p2 = (found.get(name, 0.0) for name in _NAMES)
    camera = replace(_pinhole(source), lens=LensCoefficients(model, (k1, k2, k3, k4, k5, k6), (p1, p2)))
    return camera.resized(width, height)


def in_colmaps_words(lens: LensCoefficients) -> tuple[str, list[float]]:
    """The COLMAP model that has all coefficients of a lens, and its parameters behind the intrinsics."""
    model, names = list(RENDERED[lens.model].items())[-1]
    found = dict(zip(_NAMES, (*lens.radial, *lens.tangential), strict=True))
    return model, [found[name] for name in names]


def shrunk(camera: Camera, factor: float) -> Camera:
    """The camera of an image whose sides are divided by `factor` (rounded, at least 1 px)."""
    return camera.resized(max(1, round(camera.width / factor)), max(1, round(camera.height / factor)))


def _pinhole(camera: pycolmap.Camera) -> Camera:
    """Intrinsics of a PINHOLE or SIMPLE_PINHOLE camera."""
    matrix = camera.calibration_matrix()
    fx, fy, cx, cy = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(fx, fy, cx, cy, camera.width, camera.height)
