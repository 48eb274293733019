"""A prepared capture resampled to the views of a scene that was prepared by hand, so that both train on the same.

The scene is RGBT-Scenes' layout with one PINHOLE camera. Its scene.json has the vendor's file of each frame
(``source_names``), the thermal lens that was used (``tir_K``, ``tir_dist_opencv``), the pose between the cameras
(``rgb_to_tir_rodrigues_t``), the drift of each frame that was taken off (``frame_offset_dn``), and the span of counts
that is shown (``thermal_dn_lo``, ``thermal_dn_hi``). The vignette that was taken off, too, is found again by least
squares: raw counts minus the scene's, at the sensor's pixels.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2  # before pycolmap, see src/thermosplat/datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.datasets.images.image_files import read_image
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.whole_files import write_jpeg, write_png
from thermosplat.runs.atomic_writes import write_text

Array = NDArray[np.float64]
_DEGREE = 4
"""Of the vignette's polynomial in the sensor's coordinates."""
_BLURS = (96.0, 48.0, 24.0, 12.0, 6.0)
"""Standard deviations [px] at which sparse depths are spread, from far to near."""


@dataclass(frozen=True, eq=False)
class HandMade:
    """A scene that was prepared by hand.

    Args:
        folder: Its folder.
        model: Its COLMAP model.
        notes: Its scene.json.
    """

    folder: Path
    model: pycolmap.Reconstruction
    notes: dict[str, Any]

    @classmethod
    def read(cls, folder: Path) -> "HandMade":
        """The scene of a folder."""
        notes = json.loads((folder / "scene.json").read_text())
        return cls(folder, pycolmap.Reconstruction(folder / "sparse" / "0"), notes)

    @property
    def camera(self) -> pycolmap.Camera:
        """The camera that all views share."""
        (camera,) = self.model.cameras.values()
        return camera

    def file(self, kind: str, stem: str, ending: str) -> Path:
        """An image of a view, in train/ or test/."""
        (path,) = self.folder.glob(f"{kind}/*/{stem}.{ending}")
        return path


def write_scene_as_shown(scene: HandMade, folder: Path) -> None:
    """The scene with its thermal counts between the span's ends, as one channel of 16 bits."""
    for stem in scene.notes["source_names"]:
        thermal = scene.file("thermal_raw", stem, "png")
        _write_view(scene, folder, stem, read_image(scene.file("rgb", stem, "jpg")), read_image(thermal))
    _write_model(scene.model, folder)


def write_capture_as_scene(capture: CaptureFolder, scene: HandMade, folder: Path) -> float:
    """The capture's photographs and thermal images in the scene's views, with its own poses, lenses and rig.

    Returns:
        What the recovered correction of counts leaves unexplained, as a standard deviation [counts].
    """
    model = pycolmap.Reconstruction(capture.sparse)
    by_name = {image.name: image for image in model.images.values()}
    beside = {image.frame_id: image for image in model.images.values() if image.name.startswith("thermal/")}
    vignette, left = _vignette(capture, scene)
    target = pycolmap.Reconstruction()
    camera = scene.camera
    target.add_camera_with_trivial_rig(camera)
    points = np.array([point.xyz for point in model.points3D.values()])
    turns = _turns(scene, by_name)
    for number, (stem, source) in enumerate(sorted(scene.notes["source_names"].items())):
        photograph = by_name[f"rgb/{source}"]
        thermal = beside[photograph.frame_id]
        view = pycolmap.Rigid3d(turns[stem].inverse(), np.zeros(3)) * photograph.cam_from_world()
        depth = _depth(camera, view, points)
        towards = _rays(camera) @ turns[stem].matrix().T
        rgb = _sampled(read_image(capture.images("rgb") / source), model.cameras[photograph.camera_id], towards)
        relative = (thermal.cam_from_world() * view.inverse()).matrix()
        seen = _rays(camera) * depth[..., None] @ relative[:, :3].T + relative[:, 3]
        lens = model.cameras[thermal.camera_id]
        counts = read_image(capture.images("thermal") / Path(thermal.name).name).astype(np.float32)
        counts -= scene.notes["frame_offset_dn"][number] + vignette
        _write_view(scene, folder, stem, rgb, _sampled(counts, lens, seen))
        image = pycolmap.Image(name=f"{stem}.jpg", camera_id=camera.camera_id, image_id=number + 1)
        target.add_image_with_trivial_frame(image, view)
    for point in model.points3D.values():
        target.add_point3D(point.xyz, pycolmap.Track(), point.color)
    _write_model(target, folder)
    return left


def _turns(scene: HandMade, by_name: Mapping[str, pycolmap.Image]) -> dict[str, pycolmap.Rotation3d]:
    """From each view of the scene to the photograph: what a different principal point turns."""
    views = {Path(image.name).stem: image for image in scene.model.images.values()}
    photographs = {stem: by_name[f"rgb/{source}"] for stem, source in scene.notes["source_names"].items()}
    centres = [np.array([side[stem].projection_center() for stem in views]) for side in (views, photographs)]
    from_scene = pycolmap.estimate_sim3d(*centres).rotation
    return {
        stem: photographs[stem].cam_from_world().rotation * from_scene * view.cam_from_world().rotation.inverse()
        for stem, view in views.items()
    }


def _vignette(capture: CaptureFolder, scene: HandMade) -> tuple[NDArray[np.float32], float]:
    """What was taken off the raw counts at each pixel of the sensor [H, W], and the residual's standard deviation."""
    matrix, distortion = np.array(scene.notes["tir_K"]), np.array(scene.notes["tir_dist_opencv"])
    pose = np.array(scene.notes["rgb_to_tir_rodrigues_t"])
    points = np.array([point.xyz for point in scene.model.points3D.values()])
    images = {Path(image.name).stem: image for image in scene.model.images.values()}
    pairs: Mapping[str, str] = {row.rgb: row.thermal for row in capture.read_pairs()}
    rows, values = [], []
    for number, (stem, source) in enumerate(sorted(scene.notes["source_names"].items())):
        raw = read_image(capture.images("thermal") / pairs[source]).astype(np.float32)
        seen = _rays(scene.camera) * _depth(scene.camera, images[stem].cam_from_world(), points)[..., None]
        place = cv2.projectPoints(seen[::8, ::8].reshape(-1, 1, 3), pose[:3], pose[3:], matrix, distortion)[0][:, 0]
        shown = read_image(scene.file("thermal_raw", stem, "png"))[::8, ::8].ravel().astype(np.float32)
        at = place.astype(np.float32)[None]
        here = cv2.remap(raw, at - 0.5, None, cv2.INTER_LINEAR)[0]
        inside = ((place > 2) & (place < np.array(raw.shape[::-1]) - 2)).all(1)
        rows.append(_terms(place[inside], raw.shape))
        values.append((here - shown)[inside] - scene.notes["frame_offset_dn"][number])
    terms, taken = np.concatenate(rows), np.concatenate(values)
    coefficients = np.linalg.lstsq(terms, taken, rcond=None)[0]
    near = np.abs(taken - terms @ coefficients) < 3 * np.std(taken - terms @ coefficients)
    coefficients = np.linalg.lstsq(terms[near], taken[near], rcond=None)[0]
    height, width = raw.shape
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
    left = float(np.std(taken[near] - terms[near] @ coefficients))
    return (_terms(grid, raw.shape) @ coefficients).reshape(height, width).astype(np.float32), left


def _terms(pixels: Array, shape: tuple[int, ...]) -> Array:
    """[N, M] powers of the sensor's coordinates, from -1 to 1."""
    x, y = (2 * pixels / np.array(shape[1::-1]) - 1).T
    return np.stack([x**i * y**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)], 1)


def _rays(camera: pycolmap.Camera) -> Array:
    """[H, W, 3] directions of the pixels, with z = 1."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    plane = camera.cam_from_img(np.stack([x, y], -1).reshape(-1, 2))
    return np.column_stack([plane, np.ones(len(plane))]).reshape(camera.height, camera.width, 3)


def _depth(camera: pycolmap.Camera, view: pycolmap.Rigid3d, points: Array) -> Array:
    """[H, W] depth of a view, spread from the sparse points that project into it."""
    pose = view.matrix()
    local = points @ pose[:, :3].T + pose[:, 3]
    local = local[local[:, 2] > 1e-3]
    at = np.floor(camera.img_from_cam(local)).astype(int)
    inside = (at >= 0).all(1) & (at < [camera.width, camera.height]).all(1)
    (x, y), nearness = at[inside].T, 1 / local[inside, 2]
    sums, counts = (np.zeros((camera.height, camera.width), np.float32) for _ in range(2))
    np.add.at(sums, (y, x), nearness)
    np.add.at(counts, (y, x), 1)
    spread = np.full_like(sums, np.median(nearness))
    for blur in _BLURS:
        weight = cv2.GaussianBlur(counts, (0, 0), blur)
        share = np.clip(weight * 2 * np.pi * blur**2, 0, 1)  # a whole point within the blur decides
        spread += share * (cv2.GaussianBlur(sums, (0, 0), blur) / np.maximum(weight, 1e-9) - spread)
    return 1 / spread.astype(np.float64)


def _sampled(image: NDArray[Any], camera: pycolmap.Camera, seen: Array) -> NDArray[Any]:
    """An image at where its camera sees points [H, W, 3]; at the border its outermost pixels."""
    place = camera.img_from_cam(seen.reshape(-1, 3)).reshape(*seen.shape[:2], 2) * (image.shape[1] / camera.width)
    maps = (place - 0.5).astype(np.float32)
    shrink = seen.shape[1] / image.shape[1]
    if shrink < 0.75:
        image = cv2.GaussianBlur(image, (0, 0), 0.4 / shrink)
    return cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _write_view(scene: HandMade, folder: Path, stem: str, rgb: NDArray[np.uint8], counts: NDArray[Any]) -> None:
    part = scene.file("rgb", stem, "jpg").parent.name
    low, high = scene.notes["thermal_dn_lo"], scene.notes["thermal_dn_hi"]
    levels = np.clip((counts.astype(np.float64) - low) / (high - low), 0, 1) * 65535
    write_jpeg(folder / "rgb" / part / f"{stem}.jpg", rgb)
    write_png(folder / "thermal" / part / f"{stem}.png", np.rint(levels).astype(np.uint16))
    write_text(folder / "thermal" / "units.json", json.dumps({"unit": "counts"}))


def _write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    place = folder / "sparse" / "0"
    place.mkdir(parents=True, exist_ok=True)
    model.write(place)
