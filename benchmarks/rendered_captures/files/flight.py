"""A drone's flights over the block of houses: flight_a, flight_b a week later and flight_c after two."""

import csv
import json
import tempfile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from rendered_captures.files.flight_plan import Fix, flight_mount, photograph_exif
from rendered_captures.files.mount import Variant
from rendered_captures.files.two_cameras import write_two_cameras
from rendered_captures.planck import temperature_of
from rendered_captures.rendering.band_scenes import DEPTH_THERMAL, ambient, film, thermal_scene
from rendered_captures.rendering.emission_path import emission_path
from rendered_captures.scene_builder import Builder
from rendered_captures.scenes.block import WIDTH

_MAP_SIZE = 1240, 920


def write_flight(date: int, variant: Variant, out: Path) -> None:
    """Render a flight's files, truth.json and truth_map.npz into a folder.

    Args:
        date: 0, 1 or 2.
        variant: What differs from the published flight.
        out: The folder.
    """
    plan = flight_mount(date, variant)
    mount = plan.mount
    for name, fix in zip(mount.photographs, plan.fixes, strict=True):
        mount.exif[name] = photograph_exif(name, fix, mount.visible)
    truth = write_two_cameras(mount, variant, out)
    _write_positions(out / "thermal" / "gps.csv", mount.thermal_images, plan.thermal_fixes)
    gps = {name.removesuffix("_V.JPG"): list(fix) for name, fix in zip(mount.photographs, plan.fixes, strict=True)}
    places = {"gps": gps, "gps_origin": list(plan.origin), "gps_bias_m": plan.bias.tolist()}
    more = {**places, "anomalies": plan.anomalies, "date": date, "seed": mount.seeds[0]}
    (out / "truth.json").write_text(json.dumps({**truth, "world": _WORLD, **more}))
    _write_map(mount.scene, out / "truth_map.npz", variant.samples or 64)


_WORLD = "metres, x east, y north, z up; camera to world, OpenCV axes"


def _write_positions(path: Path, names: list[str], fixes: list[Fix]) -> None:
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["name", "latitude", "longitude", "altitude"])
        for name, (latitude, longitude, altitude) in zip(names, fixes, strict=True):
            table.writerow([name, round(latitude, 8), round(longitude, 8), round(altitude, 3)])


def _write_map(scene: Builder, path: Path, samples: int) -> None:
    """Apparent temperatures from straight above, without drift and noise."""
    width, height = _MAP_SIZE
    transform = mi.ScalarTransform4f
    down = transform().look_at([0, 0, 80], [0, 0, 0], [0, 1, 0]) @ transform().scale([WIDTH / 2, WIDTH / 2, 1])
    depths: dict[str, Any] = {"near_clip": 0.1, "far_clip": 200.0}
    camera = {"type": "orthographic", "to_world": down, **depths, "film": film(width, height)}
    sensor = mi.load_dict({**camera, "sampler": {"type": "multijitter"}})
    with tempfile.TemporaryDirectory() as folder:
        loaded = thermal_scene(scene, (8, 8), scene.fov, Path(folder))
        path_tracer = emission_path(DEPTH_THERMAL, ambient(scene))
        image = np.array(mi.render(loaded, sensor=sensor, integrator=path_tracer, spp=samples, seed=5))
    celsius = np.round(temperature_of(image[..., :3].mean(-1)), 2).astype(np.float32)
    about = "apparent degC from straight above, no drift, no noise; row 0 is north, column 0 west"
    np.savez_compressed(path, celsius=celsius, metres_per_pixel=WIDTH / width, centre=(0.0, 0.0), about=about)
