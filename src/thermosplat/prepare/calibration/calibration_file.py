"""calibration.json: the lenses of both cameras and the pose between them, as a board showed them.

Poses map points of the photographs' camera to the thermal camera, in metres, with OpenCV's axes. Lenses are COLMAP
camera models with their parameters; pixel centres are at half-integers.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.lens import Lens
from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular
from thermosplat.runs.atomic_writes import write_bytes

_AGAIN = "Make it again: thermosplat-prepare calibrate CAPTURE --rgb BOARDS --thermal BOARDS"


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """Two cameras on one mount.

    Args:
        thermal_from_rgb: [4, 4] pose of the photographs' camera in the thermal camera's axes [m].
    """

    rgb: Lens
    thermal: Lens
    thermal_from_rgb: NDArray[np.float64]


def write_calibration(path: Path, calibration: RigCalibration) -> None:
    """Write a calibration, whole."""
    content = {
        "rgb": asdict(calibration.rgb),
        "thermal": asdict(calibration.thermal),
        "thermal_from_rgb": calibration.thermal_from_rgb.tolist(),
    }
    write_bytes(path, json.dumps(content, indent=1).encode())


def read_calibration(path: Path) -> RigCalibration | None:
    """The calibration in a file, or None where there is no such file.

    Raises:
        UserError: The file is damaged.
    """
    try:
        content = json.loads(read_regular(path))
        pose = np.array(content["thermal_from_rgb"], np.float64)
        rgb, thermal = (_lens(content[spectrum]) for spectrum in ("rgb", "thermal"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is damaged: {type(error).__name__}: {error}.", _AGAIN) from error
    if pose.shape != (4, 4) or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6):
        raise UserError(f"{path} is damaged: thermal_from_rgb is not a pose of 4 x 4 numbers.", _AGAIN)
    return RigCalibration(rgb, thermal, pose)


def _lens(stated: dict[str, object]) -> Lens:
    lens = Lens(
        str(stated["model"]),
        tuple(float(value) for value in stated["params"]),  # type: ignore[attr-defined]
        int(stated["width"]),  # type: ignore[call-overload]
        int(stated["height"]),  # type: ignore[call-overload]
    )
    lens.colmap_camera()  # raises ValueError for a model that COLMAP does not know
    return lens
