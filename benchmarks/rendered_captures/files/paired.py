"""Paired captures in the layout of RGBT-Scenes: desk, lab, yard."""

import json
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendered_captures.files.raster import write_counts, write_jpeg, write_png
from rendered_captures.files.sparse_points import write_model
from rendered_captures.paths import FLIP, CameraPath, look_at
from rendered_captures.rendering.band_scenes import ambient, rgb_scene, thermal_scene
from rendered_captures.rendering.emission_path import emission_path
from rendered_captures.rendering.renderer import Renderer
from rendered_captures.scene_builder import LABELS, Builder
from rendered_captures.scenes.desk import desk
from rendered_captures.scenes.lab import lab
from rendered_captures.scenes.yard import yard
from rendered_captures.sensors.palette import colored, ironbow, span_of, write_palette
from rendered_captures.sensors.photograph import developed, exposure_of
from rendered_captures.sensors.thermal_image import BLUR, NETD, counts, drifting_levels, sensed

SCENES: dict[str, Callable[[np.random.Generator], tuple[Builder, CameraPath]]] = {
    "desk": desk,
    "lab": lab,
    "yard": yard,
}
_SAMPLES = {"desk": 128, "lab": 100, "yard": 81}
"""Per pixel of the photographs as they were published; of thermal images it is ``_THERMAL_SAMPLES``."""
_THERMAL_SAMPLES = 25
_TEST_EVERY = 8


@dataclass(frozen=True)
class Paired:
    """What a capture is rendered with."""

    scene: str
    views: int = 48
    width: int = 400
    height: int = 300
    samples: int | None = None
    """Per pixel of the photographs; None: as published. Thermal images have a fifth, 25 at most."""
    seed: int = 7
    electrons: float | None = None
    """At white of photographs in the dark; None: by day."""
    drift: float | None = None
    """Span of the thermal camera's levels [K]; None: they stay."""
    jump_every: int = 0
    """Frames between two closings of the shutter; 0: one at the start."""


@dataclass(frozen=True, eq=False)
class _Made:
    """A capture that is being rendered."""

    settings: Paired
    scene: Builder
    poses: list[NDArray[np.float64]]
    names: list[str]
    parts: list[str]
    """"train" or "test", by view."""
    folder: Path
    """For files that Mitsuba reads."""
    out: Path

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of images [px]."""
        return self.settings.width, self.settings.height

    @property
    def views(self) -> "zip[tuple[NDArray[np.float64], str, str]]":
        """Pose, name and part of each view."""
        return zip(self.poses, self.names, self.parts, strict=True)


def scene_of(settings: Paired) -> tuple[Builder, list[NDArray[np.float64]]]:
    """The scene and the poses, camera to world in Mitsuba's axes."""
    key = zlib.crc32(settings.scene.encode())
    scene, path = SCENES[settings.scene](np.random.default_rng([settings.seed, key]))
    places, targets = path(settings.views, np.random.default_rng([settings.seed, 1, key]))
    return scene, [look_at(place, target) for place, target in zip(places, targets, strict=True)]


def write_paired(settings: Paired, out: Path) -> None:
    """Render a capture into a folder."""
    scene, poses = scene_of(settings)
    names = [f"{settings.scene}_{k:04d}" for k in range(len(poses))]
    parts = ["test" if k % _TEST_EVERY == 0 else "train" for k in range(len(poses))]
    with tempfile.TemporaryDirectory() as folder:
        made = _Made(settings, scene, poses, names, parts, Path(folder), out)
        exposure = _write_photographs(made)
        span = _write_thermal(made)
        seen = _write_truth(made)
        shots = Path(folder) / "photographs"
        to_camera = [np.linalg.inv(pose @ FLIP) for pose in poses]
        sparse = write_model(shots, [f"{n}.jpg" for n in names], to_camera, scene.fov, made.size, out / "sparse" / "0")
    known = {
        "scene": settings.scene,
        "views": settings.views,
        "test_rule": f"sorted index % {_TEST_EVERY} == 0",
        "camera": _camera(settings, scene.fov),
        "exposure": exposure,
        "palette_range_C": list(span),
        "netd_K": NETD,
        "psf_sigma_px": BLUR,
        "label_ids": LABELS,
        "label_pixels": seen,
        "sparse": sparse,
        "discrepancy_objects": _objects(scene),
    }
    (out / "scene.json").write_text(json.dumps(known, indent=1))


def _write_photographs(made: _Made) -> float:
    settings, scene = made.settings, made.scene
    samples = settings.samples or _SAMPLES[settings.scene]
    camera = Renderer(rgb_scene(scene, made.size, scene.fov, made.folder), made.size)
    renders = [camera.image(pose, samples, settings.seed * 1000 + k) for k, pose in enumerate(made.poses)]
    exposure = exposure_of(renders, scene.key)
    for k, (render, name, part) in enumerate(zip(renders, made.names, made.parts, strict=True)):
        image = developed(render, exposure, np.random.default_rng([settings.seed, 3, k]))
        write_jpeg(made.folder / "photographs" / f"{name}.jpg", image, 95)  # points are found by day
        if settings.electrons is not None:
            from scenes.low_light_capture import darkened  # loads PyTorch

            image = darkened(image, settings.electrons, np.random.default_rng([settings.seed, 4, k]))
        write_jpeg(made.out / "rgb" / part / f"{name}.jpg", image, 95)
    return exposure


def _write_thermal(made: _Made) -> tuple[float, float]:
    settings, scene = made.settings, made.scene
    samples = min(settings.samples or 5 * _THERMAL_SAMPLES, 5 * _THERMAL_SAMPLES) // 5 or 1
    path = emission_path(6, ambient(scene))
    camera = Renderer(thermal_scene(scene, made.size, scene.fov, made.folder), made.size, path)
    images = []
    for k, pose in enumerate(made.poses):
        render = camera.image(pose, samples, settings.seed * 1000 + 500 + k)
        images.append(sensed(render.mean(-1), np.random.default_rng([settings.seed, 2, k])))
    if settings.drift is not None:
        random = np.random.default_rng([settings.seed, 9])
        levels = drifting_levels(len(made.poses), random, settings.jump_every, settings.drift)
        images = [image + np.float32(level) for image, level in zip(images, levels, strict=True)]
        known = {f"{name}.tiff": round(float(level), 3) for name, level in zip(made.names, levels, strict=True)}
        (made.out / "level_drift_K.json").write_text(json.dumps(known))
    span, palette = span_of(images), ironbow()
    for image, name, part in zip(images, made.names, made.parts, strict=True):
        write_jpeg(made.out / "thermal" / part / f"{name}.jpg", colored(image, span, palette), 95)
        write_counts(made.out / "thermal_raw" / f"{name}.tiff", counts(image))
    units = {"unit": "centi-Kelvin", "palette_min_C": span[0], "palette_max_C": span[1]}
    (made.out / "thermal_raw" / "units.json").write_text(json.dumps(units))
    write_palette(made.out / "ironbow_lut.json", palette)
    return span


def _write_truth(made: _Made) -> dict[str, int]:
    """Labels of all views; depths of what each spectrum sees in the held-out ones."""
    scene, size, folder, seen = made.scene, made.size, made.folder, dict.fromkeys(LABELS, 0)
    surfaces = Renderer(thermal_scene(scene, size, scene.fov, folder), size)
    light = Renderer(rgb_scene(scene, size, scene.fov, folder, lambda thing: thing.disc != "glass"), size)
    heat = Renderer(thermal_scene(scene, size, scene.fov, folder, lambda thing: thing.tau == 0), size)
    numbers = surfaces.numbers()
    (made.out / "ground_truth").mkdir(parents=True, exist_ok=True)
    for pose, name, part in made.views:
        _, shapes = surfaces.first_hit(pose)
        label = np.zeros(shapes.shape, np.uint8)
        for thing in scene.objs:
            if thing.disc is not None:
                label[shapes == numbers[thing.name]] = LABELS[thing.disc]
        write_png(made.out / "labels" / part / f"{name}.png", label)
        for kind, number in LABELS.items():
            seen[kind] += int((label == number).sum())
        if part == "test":
            depths = {"depth_rgb": light.first_hit(pose)[0], "depth_thermal": heat.first_hit(pose)[0]}
            rounded = {key: _rounded(depth) for key, depth in depths.items()}
            np.savez_compressed(made.out / "ground_truth" / f"{name}.npz", **rounded, label=label)
    return seen


def _rounded(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depths without their lowest bits, so that the file compresses; steps of at most 1/2000 of the median."""
    step = 2.0 ** np.floor(np.log2(np.median(depth[depth > 0]) / 2000))
    return (np.round(depth / step) * step).astype(np.float32)


def _camera(settings: Paired, fov: float) -> dict[str, Any]:
    focal = float(settings.width / (2 * np.tan(np.radians(fov) / 2)))
    size = {"width": settings.width, "height": settings.height}
    return {"model": "PINHOLE", **size, "fx": focal, "fy": focal, "cx": settings.width / 2, "cy": settings.height / 2}


def _objects(scene: Builder) -> list[dict[str, Any]]:
    """What photographs and thermal images disagree on."""
    return [
        {
            "name": thing.name,
            "kind": thing.disc,
            "about": thing.about,
            "bbox_min": thing.mesh.vertices.min(axis=0).round(3).tolist(),
            "bbox_max": thing.mesh.vertices.max(axis=0).round(3).tolist(),
            "T_C": [round(float(np.min(thing.T)), 2), round(float(np.max(thing.T)), 2)],
            "eps": thing.eps,
            "tau": thing.tau,
        }
        for thing in scene.objs
        if thing.disc is not None
    ]
