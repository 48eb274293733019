"""A plain COLMAP project: images/, a sparse model, and a folder per further spectrum with the stems of the photographs.

thermal/ may hold pseudo-colour, grey, or radiometric files (16-bit PNG, float TIFF). Images that are not in the model
share the photograph's camera; that has to show in equal sizes, or be said (``--thermal.aligned``).
"""

from collections.abc import Mapping
from pathlib import Path

from thermosplat.datasets.colmap.model import ColmapModel
from thermosplat.datasets.colmap.shared_cameras import frames_with_borrowed_cameras
from thermosplat.datasets.frame_files import Listing
from thermosplat.datasets.images.image_folders import image_folder
from thermosplat.spectra import SpectrumConfig, folder_names


def list_colmap_folder(root: Path, model: ColmapModel, spectra: Mapping[str, SpectrumConfig]) -> Listing:
    """Files, cameras and points of a capture in this layout.

    Args:
        root: The capture's folder.
        model: Its COLMAP model.
        spectra: The spectra to look for; the first one's images are in the model.
    """
    leading, settings = next(iter(spectra.items()))
    folder = image_folder(root, "images", folder_names(leading, settings))
    frames, notes = frames_with_borrowed_cameras(root, folder, model.images, spectra)
    return Listing("colmap", tuple(frames), model.points, model.point_colors, registered=False, notes=tuple(notes))
