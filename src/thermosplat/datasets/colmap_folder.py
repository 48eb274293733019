"""A plain COLMAP project: images/, a sparse model, and thermal/ beside them with the stems of the RGB images.

thermal/ may hold pseudo-colour, grey, or radiometric files (16-bit PNG, float TIFF). Thermal images that are not in the
model share the RGB image's camera; that has to show in equal sizes, or be said (``--thermal.aligned``).
"""

from pathlib import Path

from thermosplat.datasets.colmap_images import frames_with_borrowed_cameras
from thermosplat.datasets.colmap_model import ColmapModel
from thermosplat.datasets.frame_files import Listing
from thermosplat.datasets.image_folders import image_folder, thermal_folder


def list_colmap_folder(root: Path, model: ColmapModel) -> Listing:
    """Files, cameras and points of a capture in this layout.

    Args:
        root: The capture's folder.
        model: Its COLMAP model.
    """
    frames, notes = frames_with_borrowed_cameras(
        image_folder(root, "images"), thermal_folder(root), root / "thermal_raw", model.images
    )
    return Listing("colmap", tuple(frames), model.points, model.point_colors, registered=False, notes=tuple(notes))
