"""RGBT-Scenes, as ThermalGaussian published it: rgb/{train,test}, thermal/{train,test} and a COLMAP model.

Both spectra of a frame have one stem, one pose and one camera. Without train/ and test/ the files lie in rgb/ and
thermal/ themselves. Radiometric values may lie in thermal_raw/, divided or flat.
"""

from pathlib import Path

from thermosplat.datasets.colmap_images import frames_with_borrowed_cameras
from thermosplat.datasets.colmap_model import ColmapModel
from thermosplat.datasets.frame_files import Listing
from thermosplat.datasets.image_folders import image_folder, thermal_folder


def list_rgbt_scenes(root: Path, model: ColmapModel) -> Listing:
    """Files, cameras and points of a capture in this layout.

    Args:
        root: The capture's folder.
        model: Its COLMAP model.
    """
    frames, notes = frames_with_borrowed_cameras(
        image_folder(root, "rgb"), thermal_folder(root), root / "thermal_raw", model.images
    )
    return Listing("rgbt-scenes", tuple(frames), model.points, model.point_colors, notes=tuple(notes))
