"""Are thermal images of another hour placed where they were taken?

    thermosplat-prepare data/flight_a/visible --thermal data/flight_b/thermal --out captures/night
    python benchmarks/bench_placing.py captures/night data/flight_a/truth.json data/flight_b/truth.json

The truths (``preparation/rig_truth.py``) share one world. The error of an image is the median distance [px] between
where the points of the photographs' model land in the found and in the true camera, of those inside the true image.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)
import numpy as np
import pycolmap

_RIGHT, _WRONG = 2.0, 6.0
"""Errors [px] up to which an image is placed rightly, and from which on it is wrong."""
_LEAST_TRACK = 3
"""Photographs that show a point which is followed."""


def placing_errors(sparse: Path, day: dict[str, Any], night: dict[str, Any]) -> dict[str, float | None]:
    """The error of each thermal image by its name [px]; None: left out."""
    model = pycolmap.Reconstruction(sparse)
    images = {image.name: image for image in model.images.values() if image.has_pose}
    photographs = {Path(name).stem: image for name, image in images.items() if name.startswith("rgb/")}
    true = {Path(name).stem: np.array(pose) for name, pose in day["camera_to_world"].items()}
    shared = sorted(true.keys() & photographs.keys())
    centres = [np.array([true[name][:3, 3] for name in shared])]
    centres.append(np.array([photographs[name].projection_center() for name in shared]))
    to_truth = pycolmap.estimate_sim3d(centres[1], centres[0])
    followed = [point.xyz for point in model.points3D.values() if point.track.length() >= _LEAST_TRACK]
    points = np.column_stack([followed, np.ones(len(followed))])
    lens = night["thermal"]
    parameters = [lens[key] for key in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")]
    camera = pycolmap.Camera(model="OPENCV", width=lens["width"], height=lens["height"], params=parameters)
    thermal = {Path(name).stem: image for name, image in images.items() if name.startswith("thermal/")}
    errors: dict[str, float | None] = {}
    for name, pose in night["camera_to_world"].items():
        stem = Path(name).stem.removesuffix("_V") + "_T"
        if stem not in thermal:
            errors[stem] = None
            continue
        world_to_camera = np.linalg.inv(np.array(pose) @ night["thermal_to_visible"])[:3]
        local = np.column_stack([points @ to_truth.matrix().T, points[:, 3]]) @ world_to_camera.T
        before = local[:, 2] > 0
        pixels = camera.img_from_cam(local[before])
        inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        found = thermal[stem]
        seen = points[before][inside] @ found.cam_from_world().matrix().T
        landed = model.cameras[found.camera_id].img_from_cam(seen)
        errors[stem] = float(np.median(np.linalg.norm(landed - pixels[inside], axis=1)))
    return errors


def main() -> None:
    """Print how many images are placed rightly, and each that is not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, help="what thermosplat-prepare made")
    parser.add_argument("day", type=Path, help="truth.json of the photographs")
    parser.add_argument("night", type=Path, help="truth.json of the thermal images")
    arguments = parser.parse_args()
    truths = [json.loads(path.read_text()) for path in (arguments.day, arguments.night)]
    errors = placing_errors(arguments.capture / "sparse" / "0", truths[0], truths[1])
    placed = [error for error in errors.values() if error is not None]
    right, wrong = sum(error < _RIGHT for error in placed), sum(error > _WRONG for error in placed)
    print(f"{len(placed)} of {len(errors)} placed: {right} within {_RIGHT:g} px, {wrong} beyond {_WRONG:g} px, median")
    print(f"{np.median(placed):.2f} px, 95% {np.percentile(placed, 95):.2f} px" if placed else "none")
    for name, error in sorted(errors.items()):
        if error is None or error > _RIGHT:
            print(f"{name}: {'left out' if error is None else f'{error:.1f} px'}")


if __name__ == "__main__":
    main()
