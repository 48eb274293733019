"""The COLMAP model of a capture: true poses, and points that SIFT finds on the photographs."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray


def write_model(
    photographs: Path,
    names: list[str],
    world_to_camera: list[NDArray[Any]],
    fov: float,
    size: tuple[int, int],
    out: Path,
) -> dict[str, float]:
    """Triangulate points with the poses that are known.

    Args:
        photographs: Folder with the files of ``names``, all of one size.
        names: The photographs.
        world_to_camera: Their poses in COLMAP's axes, each [4, 4].
        fov: Across [degrees].
        size: Width and height.
        out: Folder of the model.

    Returns:
        How many points there are, and their mean error of reprojection [pixels].
    """
    width, height = size
    focal = float(width / (2 * np.tan(np.radians(fov) / 2)))
    camera = f"PINHOLE {width} {height} {focal!r} {focal!r} {width / 2} {height / 2}"
    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = 2  # errors
    with tempfile.TemporaryDirectory() as folder:
        database, known = Path(folder) / "database.db", Path(folder) / "known"
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model, reader.camera_params = "PINHOLE", ",".join(camera.split()[3:])
        extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
        extraction.sift.peak_threshold, extraction.sift.max_num_features = 0.012, 2500
        extraction.num_threads = matching.num_threads = 2
        alone, device = pycolmap.CameraMode.SINGLE, pycolmap.Device.cpu
        pycolmap.extract_features(
            database,
            photographs,
            image_names=names,
            camera_mode=alone,
            reader_options=reader,
            extraction_options=extraction,
            device=device,
        )
        pycolmap.match_exhaustive(database, matching_options=matching, device=device)
        with pycolmap.Database.open(database) as opened:
            numbers = {image.name: image.image_id for image in opened.read_all_images()}
            (found,) = opened.read_all_cameras()
        known.mkdir()
        (known / "cameras.txt").write_text(f"{found.camera_id} {camera}\n")
        (known / "points3D.txt").write_text("")
        lines = (
            f"{numbers[name]} {_pose(matrix)} {found.camera_id} {name}\n\n"
            for name, matrix in zip(names, world_to_camera, strict=True)
        )
        (known / "images.txt").write_text("".join(lines))
        model = pycolmap.triangulate_points(
            pycolmap.Reconstruction(known), database, photographs, Path(folder) / "triangulated"
        )
        model.extract_colors_for_all_images(photographs)
    out.mkdir(parents=True, exist_ok=True)
    model.write_binary(out)
    return {"points3D": len(model.points3D), "mean_reprojection_px": float(model.compute_mean_reprojection_error())}


def _pose(matrix: NDArray[Any]) -> str:
    x, y, z, w = pycolmap.Rotation3d(matrix[:3, :3]).quat
    return " ".join(repr(float(value)) for value in (w, x, y, z, *matrix[:3, 3]))
