"""RGBT-Scenes, as ThermalGaussian published it: rgb/{train,test}, thermal/{train,test} and a COLMAP model.

Both spectra of a frame have one stem, one pose and one camera. Without train/ and test/ the files lie in rgb/ and
thermal/ themselves. Radiometric values may lie in thermal_raw/, divided or flat.
"""

from collections.abc import Mapping
from pathlib import Path

from thermosplat.datasets.colmap.model import ColmapModel
from thermosplat.datasets.colmap.shared_cameras import frames_with_borrowed_cameras
from thermosplat.datasets.frame_files import Listing
from thermosplat.datasets.images.image_folders import image_folder
from thermosplat.spectra import SpectrumConfig, folder_names


def list_rgbt_scenes(root: Path, model: ColmapModel, spectra: Mapping[str, SpectrumConfig]) -> Listing:
    """Files, cameras and points of a capture in this layout.

    Args:
        root: The capture's folder.
        model: Its COLMAP model.
        spectra: The spectra to look for; the first one's images are in the model.
    """
    leading, settings = next(iter(spectra.items()))
    folder = image_folder(root, folder_names(leading, settings)[0])
    frames, notes = frames_with_borrowed_cameras(root, folder, model.images, spectra)
    return Listing("rgbt-scenes", tuple(frames), model.points, model.point_colors, notes=tuple(notes))
