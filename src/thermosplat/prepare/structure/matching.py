"""Features of the photographs and what matches between them, in a COLMAP database that an interrupted run goes on with.

Everything is done in small lots, so that a killed process loses one lot only.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.prepare.capture_folder import FrameRow
from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.structure.likeness import likeness
from thermosplat.prepare.structure.pairs import chosen_pairs

MAX_FEATURES = 4096
"""Per photograph; half of COLMAP's default, which quarters the time of matching."""
MAX_SIDE = 2000
"""Larger photographs are matched at this size [px]."""
_LOT_OF_PHOTOGRAPHS, _LOT_OF_PAIRS = 8, 64
_RGB = "rgb/"

Item = TypeVar("Item")


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's own log from the terminal, except for fatal errors."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


@contextmanager
def opened(database: Path) -> Iterator[pycolmap.Database]:
    """An open database, closed afterwards."""
    connection = pycolmap.Database.open(database)
    try:
        yield connection
    finally:
        connection.close()


def enter_photographs(database: Path, cameras: Sequence[tuple[pycolmap.Camera, list[FrameRow]]]) -> None:
    """Enter cameras and photographs, each photograph a frame of its own. What is there already stays.

    Args:
        database: File of the database; made where it is not there.
    """
    with opened(database) as connection, pycolmap.DatabaseTransaction(connection):
        image_id = 0
        for camera_id, (camera, rows) in enumerate(cameras, start=1):
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
            if not connection.exists_camera(camera_id):
                camera.camera_id = camera_id
                connection.write_camera(camera, use_camera_id=True)
                rig = pycolmap.Rig(rig_id=camera_id)
                rig.add_ref_sensor(sensor)
                connection.write_rig(rig, use_rig_id=True)
            for row in rows:
                image_id += 1
                if connection.exists_image(image_id):
                    continue
                frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
                frame.add_data_id(pycolmap.data_t(sensor, image_id))
                connection.write_frame(frame, use_frame_id=True)
                image = pycolmap.Image(name=_RGB + row.file, camera_id=camera_id, image_id=image_id)
                image.frame_id = image_id
                connection.write_image(image, use_image_id=True)


def extract(database: Path, images: Path) -> None:
    """Find features in all photographs that have none yet."""
    with opened(database) as connection:
        every = connection.read_all_images()
        names = [image.name for image in every if not connection.exists_keypoints(image.image_id)]
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = MAX_SIDE
    options.sift.max_num_features = MAX_FEATURES
    with progress_bar("features", len(every)) as advance:
        advance(len(every) - len(names))
        for lot in _lots(names, _LOT_OF_PHOTOGRAPHS):
            pycolmap.extract_features(database, images, image_names=lot, extraction_options=options)
            advance(len(lot))


def match(database: Path, places: Mapping[str, NDArray[np.float64]]) -> None:
    """Match the photographs and verify the matches, where that has not been done yet.

    Args:
        places: East, north, up [m] of photographs whose position is known, by file, [3] each.
    """
    with opened(database) as connection:
        names = {
            image.image_id: image.name
            for image in sorted(connection.read_all_images(), key=lambda image: image.name)
            if connection.exists_keypoints(image.image_id)
        }
        ids = list(names)
        unknown = np.full(3, np.nan)
        known = np.array([places.get(name.removeprefix(_RGB), unknown) for name in names.values()]).reshape(-1, 3)
        chosen = chosen_pairs(known, lambda: likeness(connection, ids))
        pairs = [(ids[one], ids[other]) for one, other in chosen]
        todo = [pair for pair in pairs if not connection.exists_two_view_geometry(*pair)]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    listed = database.with_name("pairs.txt")
    with progress_bar("matches", len(pairs)) as advance:
        advance(len(pairs) - len(todo))
        for lot in _lots(todo, _LOT_OF_PAIRS):
            listed.write_text("".join(f"{names[one]} {names[other]}\n" for one, other in lot), encoding="utf-8")
            pairing = pycolmap.ImportedPairingOptions()
            pairing.match_list_path = str(listed)
            pycolmap.match_image_pairs(database, pairing_options=pairing, verification_options=verification)
            advance(len(lot))
    listed.unlink(missing_ok=True)


def _lots(items: Sequence[Item], size: int) -> Iterator[list[Item]]:
    for start in range(0, len(items), size):
        yield list(items[start : start + size])
