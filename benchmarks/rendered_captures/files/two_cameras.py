"""Raw files of a photographic and a thermal camera on one mount: lenses, sizes and poses of their own."""

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rendered_captures.files.mount import Mount, Variant
from rendered_captures.files.raster import write_counts, write_jpeg
from rendered_captures.paths import FLIP
from rendered_captures.rendering.band_scenes import DEPTH_THERMAL, ambient, rgb_scene, thermal_scene
from rendered_captures.rendering.emission_path import emission_path
from rendered_captures.rendering.renderer import Renderer
from rendered_captures.sensors.lens import Lens
from rendered_captures.sensors.photograph import developed, exposure_of
from rendered_captures.sensors.shutter import LineMotion, motions
from rendered_captures.sensors.thermal_image import counts, drifting_levels, sensed

Array = NDArray[np.float64]


def write_two_cameras(mount: Mount, variant: Variant, out: Path) -> dict[str, Any]:
    """Render both cameras' files into visible/ and thermal/.

    Returns:
        What truth.json has of them: camera to world in OpenCV's axes, lenses, levels.
    """
    visible, thermal = mount.visible.scaled(variant.size_factor), mount.thermal.scaled(variant.size_factor)
    inside = np.eye(4)
    inside[:3, :3] = cv2.Rodrigues(np.radians(np.array(mount.turn)))[0]
    inside[:3, 3] = mount.offset
    midway = _between(mount.poses) if variant.unpaired else mount.poses
    thermal_poses = [pose @ FLIP @ inside for pose in midway]
    with tempfile.TemporaryDirectory() as folder:
        for name, image in zip(mount.photographs, _photographs(mount, variant, visible, Path(folder)), strict=True):
            write_jpeg(out / "visible" / name, image, mount.jpeg, mount.exif.get(name, b""))
        levels = _levels(mount, variant)
        images = _thermal_images(mount, variant, thermal, thermal_poses, Path(folder))
        for name, level, image in zip(mount.thermal_images, levels, images, strict=True):
            write_counts(out / "thermal" / name, counts(image + level))
    truth = {
        "world": "metres, z up; camera to world, OpenCV axes",
        "visible": visible.described(),
        "thermal": thermal.described(),
        "thermal_to_visible": inside.tolist(),
        "camera_to_world": _listed(mount.photographs, [pose @ FLIP for pose in mount.poses]),
        "pairs": "none" if variant.unpaired else "same number",
    }
    if variant.unpaired:
        truth["thermal_camera_to_world"] = _listed(mount.thermal_images, thermal_poses)
    if levels.any():
        truth["level_drift_K"] = dict(zip(mount.thermal_images, levels.astype(float).round(3).tolist(), strict=True))
    if variant.readout > 0:
        shutter = {"thermal": {"readout": variant.readout, "interval": 1}}
        (out / "shutter.json").write_text(json.dumps(shutter))
    return truth


def _photographs(mount: Mount, variant: Variant, lens: Lens, folder: Path) -> Iterator[NDArray[np.uint8]]:
    camera = Renderer(rgb_scene(mount.scene, lens.rendered_size, lens.fov, folder), lens.rendered_size)
    samples = variant.samples or mount.samples[0]
    renders = (lens.bent(camera.image(p, samples, mount.seeds[0] * 1000 + k)) for k, p in enumerate(mount.poses))
    if mount.metered is None:
        renders = list(renders)
        exposure = exposure_of(renders, mount.scene.key)
    else:
        exposure = exposure_of([camera.image(mount.poses[mount.metered], 8, 1)], mount.scene.key)
    for k, render in enumerate(renders):
        image = developed(render, exposure, mount.rng(3, k))
        if variant.electrons is not None:
            from scenes.low_light_capture import darkened  # loads PyTorch

            image = darkened(image, variant.electrons, mount.rng(4, k))
        yield image


def _thermal_images(
    mount: Mount, variant: Variant, lens: Lens, poses: list[Array], folder: Path
) -> Iterator[NDArray[np.float32]]:
    scene = thermal_scene(mount.scene, lens.rendered_size, lens.fov, folder)
    path = emission_path(DEPTH_THERMAL, ambient(mount.scene))
    camera, samples = Renderer(scene, lens.rendered_size, path), variant.samples or mount.samples[1]
    moving = motions(poses, variant.readout)
    for k, (pose, (velocity, turn)) in enumerate(zip(poses, moving, strict=True)):
        if variant.readout > 0:
            path.move(LineMotion(velocity, turn, lens.height, lens.focal, lens.cy, lens.k1, lens.k2))
        render = camera.image(pose @ FLIP, samples, mount.seeds[0] * 1000 + 500 + k)
        yield sensed(lens.bent(render.mean(-1)), mount.rng(2, k))


def _levels(mount: Mount, variant: Variant) -> NDArray[np.float32]:
    span = mount.drift if variant.drift is None else variant.drift
    every = mount.jump_every if variant.jump_every is None else variant.jump_every
    return drifting_levels(len(mount.poses), mount.rng(9), every, span).astype(np.float32)


def _between(poses: list[Array]) -> list[Array]:
    """Poses half-way to the next ones; the last is half-way back."""
    halfway = []
    for k, pose in enumerate(poses):
        other = poses[k + 1] if k + 1 < len(poses) else poses[k - 1]
        turn = cv2.Rodrigues(other[:3, :3] @ pose[:3, :3].T)[0] / 2
        middle = pose.copy()
        middle[:3, :3] = cv2.Rodrigues(turn)[0] @ pose[:3, :3]
        middle[:3, 3] = (pose[:3, 3] + other[:3, 3]) / 2
        halfway.append(middle)
    return halfway


def _listed(names: list[str], poses: list[Array]) -> dict[str, Any]:
    return {name: pose.tolist() for name, pose in zip(names, poses, strict=True)}
