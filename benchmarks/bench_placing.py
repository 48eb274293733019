"""Are thermal images of another hour placed where they were taken?

    thermosplat-prepare data/flight_a/visible --thermal data/flight_b/thermal --out captures/night
    python benchmarks/bench_placing.py captures/night data/flight_a/truth.json data/flight_b/truth.json
    python benchmarks/bench_placing.py captures/lab --every-second data/rgbt_synthetic/lab

The second makes captures/lab: photographs of odd frames, thermal images of even ones without a pose, and places these;
captures/lab_true is the same with true thermal cameras, to be trained beside it.
The truths (``preparation/rig_truth.py``) share one world. The error of an image is the median distance [px] between
where the points of the photographs' model land in the found and in the true camera, of those inside the true image.
"""

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder, FrameRow
from thermosplat.prepare.placing.place_step import place_unpaired

Array = NDArray[np.float64]

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
        to_camera = world_to_camera @ np.vstack([to_truth.matrix(), [0, 0, 0, 1]])
        found = thermal[stem]
        pose_found = found.cam_from_world().matrix()
        errors[stem] = _error(points, to_camera, camera, pose_found, model.cameras[found.camera_id])
    return errors


def placed_every_second(capture: CaptureFolder, paired: Path) -> dict[str, float | None]:
    """The error of the thermal images of every second frame of a paired capture, whose cameras are one."""
    model = pycolmap.Reconstruction(paired / "sparse" / "0")
    even, odd = (sorted(model.images.values(), key=lambda image: image.name)[first::2] for first in (0, 1))
    for spectrum in (LEADING, OTHER):
        capture.images(spectrum).mkdir(parents=True)
    frames = []
    for image in even:
        values = cv2.imread(str(paired / "thermal_raw" / f"{Path(image.name).stem}.tiff"), cv2.IMREAD_UNCHANGED)
        frames.append(FrameRow(OTHER, f"{Path(image.name).stem}.png", image.name, *values.shape[::-1]))
        cv2.imwrite(str(capture.images(OTHER) / frames[-1].file), values)
    shutil.copy(paired / "thermal_raw" / "units.json", capture.units_json)
    capture.write_frames(frames)
    capture.write_pairs([])
    true = {Path(image.name).stem: image.cam_from_world().matrix() for image in even}
    for image in even:
        model.deregister_frame(image.frame_id)
    for image in odd:
        shutil.copy(next((paired / LEADING).rglob(image.name)), capture.images(LEADING))
        image.name = f"{LEADING}/{image.name}"
    camera = model.cameras[odd[0].camera_id]
    print("\n".join(place_unpaired(capture, model)))
    made = pycolmap.Reconstruction(capture.sparse)
    placed = {Path(image.name).stem: image for image in made.images.values() if image.name.startswith(OTHER)}
    points = np.array([(*p.xyz, 1.0) for p in made.points3D.values() if p.track.length() >= _LEAST_TRACK])
    errors: dict[str, float | None] = dict.fromkeys(true)
    for stem, found in placed.items():
        errors[stem] = _error(
            points, true[stem], camera, found.cam_from_world().matrix(), made.cameras[found.camera_id]
        )
    _write_with_true_cameras(capture.root, made, true, camera)
    return errors


def _write_with_true_cameras(
    folder: Path, made: pycolmap.Reconstruction, true: dict[str, Array], camera: pycolmap.Camera
) -> None:
    """FOLDER_true: a placed capture whose thermal images have their true poses [3, 4] and their true camera."""
    copied = folder.with_name(f"{folder.name}_true")
    shutil.copytree(folder, copied)
    for image in made.images.values():
        if image.name.startswith(OTHER):
            found = made.cameras[image.camera_id]
            found.model, found.params = camera.model, camera.params
            made.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(true[Path(image.name).stem])
    made.write(copied / "sparse" / "0")


def _error(
    points: Array, true_pose: Array, true_camera: pycolmap.Camera, pose: Array, camera: pycolmap.Camera
) -> float:
    """Median distance [px] between where points [N, 4] inside the true image land in both cameras."""
    local = points @ true_pose.T
    pixels = true_camera.img_from_cam(local)
    inside = (local[:, 2] > 0) & (pixels > 0).all(1) & (pixels < [true_camera.width, true_camera.height]).all(1)
    landed = camera.img_from_cam(points[inside] @ pose.T)
    return float(np.median(np.linalg.norm(landed - pixels[inside], axis=1)))


def main() -> None:
    """Print how many images are placed rightly, and each that is not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, help="what thermosplat-prepare made, or a new folder")
    parser.add_argument("truths", type=Path, nargs="*", help="truth.json of the photographs, and of the thermal images")
    parser.add_argument("--every-second", type=Path, metavar="PAIRED", help="a paired capture of one camera")
    arguments = parser.parse_args()
    if arguments.every_second:
        errors = placed_every_second(CaptureFolder(arguments.capture), arguments.every_second)
    else:
        day, night = (json.loads(path.read_text()) for path in arguments.truths)
        errors = placing_errors(arguments.capture / "sparse" / "0", day, night)
    placed = [error for error in errors.values() if error is not None]
    right, wrong = sum(error < _RIGHT for error in placed), sum(error > _WRONG for error in placed)
    print(f"{len(placed)} of {len(errors)} placed: {right} within {_RIGHT:g} px, {wrong} beyond {_WRONG:g} px, median")
    print(f"{np.median(placed):.2f} px, 95% {np.percentile(placed, 95):.2f} px" if placed else "none")
    for name, error in sorted(errors.items()):
        if error is None or error > _RIGHT:
            print(f"{name}: {'left out' if error is None else f'{error:.1f} px'}")


if __name__ == "__main__":
    main()
