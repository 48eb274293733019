"""Mitsuba's scenes of a scene: one of light, one of heat."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rendered_captures.materials import Painted
from rendered_captures.meshes.mesh import write_ply
from rendered_captures.planck import radiance_of
from rendered_captures.scene_builder import Builder, Object

DEPTH_RGB, DEPTH_THERMAL = 3, 6
"""Surfaces of a path at most."""
Chosen = Callable[[Object], bool]


def rgb_scene(scene: Builder, size: tuple[int, int], fov: float, folder: Path, only: Chosen | None = None) -> Any:
    """The scene of light.

    Args:
        scene: What is in it.
        size: Width and height of the image.
        fov: Across [degrees].
        folder: Takes the meshes' files.
        only: Which objects; None: all.
    """
    parts = {**_camera(size, fov), "integrator": {"type": "volpath", "max_depth": DEPTH_RGB}}
    if scene.env_rgb is not None:  # none in closed rooms: it would only waste light samples
        parts["env"] = _surroundings(scene.env_rgb)
    if scene.sun is not None:
        direction, irradiance = scene.sun
        light = {"type": "rgb", "value": list(irradiance)}
        parts["sun"] = {"type": "directional", "direction": list(direction), "irradiance": light}
    for thing in scene.objs:
        if only is None or only(thing):
            part = {
                **_shape(thing.mesh_rgb or thing.mesh, folder / f"rgb_{thing.name}.ply"),
                "bsdf": _filled(thing.rgb),
            }
            if thing.emit is not None:
                part["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": list(thing.emit)}}
            parts[thing.name] = part
    return mi.load_dict(parts, parallel=False)  # parallel loading shuffles the order of lights, and so the noise


def thermal_scene(scene: Builder, size: tuple[int, int], fov: float, folder: Path, only: Chosen | None = None) -> Any:
    """The scene of heat: radiances between 8 and 14 um [W/m^2/sr]; arguments as of ``rgb_scene``."""
    parts = _camera(size, fov)
    around = radiance_of(scene.room_T if scene.env_T is None else scene.env_T)
    if around.ndim:
        parts["env"] = _surroundings(np.repeat(around[..., None], 3, -1).astype(np.float32))
    else:
        parts["env"] = {"type": "constant", "radiance": _grey(around)}
    for thing in scene.objs:
        if only is None or only(thing):
            emitter = {"type": "area", "radiance": _emission(thing)}
            shape = _shape(thing.mesh, folder / f"thermal_{thing.name}.ply")
            parts[thing.name] = {**shape, "bsdf": _thermal_surface(thing), "emitter": emitter}
    return mi.load_dict(parts, parallel=False)


def ambient(scene: Builder) -> float:
    """Radiance of the room [W/m^2/sr], which paths see that are too long."""
    return float(radiance_of(scene.room_T))


def _thermal_surface(thing: Object) -> dict[str, Any]:
    if thing.tau > 0:  # index-matched: it passes sqrt(tau) per face and reflects nothing
        through = {"specular_transmittance": _grey(thing.tau**0.5), "specular_reflectance": _grey(0)}
        return {"type": "thindielectric", "int_ior": 1.0, "ext_ior": 1.0, **through}
    reflected = _grey(1 - thing.eps - thing.tau)
    if thing.mirror is None:
        surface = {"type": "diffuse", "reflectance": reflected}
    elif thing.mirror == 0:
        surface = {"type": "conductor", "material": "none", "specular_reflectance": reflected}
    else:
        rough = {"type": "roughconductor", "material": "none", "alpha": thing.mirror}
        surface = {**rough, "specular_reflectance": reflected}
    return {"type": "twosided", "bsdf": surface}


def _emission(thing: Object) -> dict[str, Any]:
    radiance = thing.eps * radiance_of(np.asarray(thing.T, float))
    if radiance.ndim == 0:
        return _grey(radiance)
    image = np.ascontiguousarray(np.repeat(radiance[::-1, :, None], 3, 2), np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}


def _camera(size: tuple[int, int], fov: float) -> dict[str, Any]:
    sensor = {"type": "perspective", "fov": fov, "fov_axis": "x", "near_clip": 0.02, "far_clip": 1000.0}
    return {"type": "scene", "sensor": {**sensor, "film": film(*size), "sampler": {"type": "multijitter"}}}


def film(width: int, height: int) -> dict[str, Any]:
    """What an image is collected on: linear floats, pixels that do not share samples."""
    pixels = {"pixel_format": "rgb", "component_format": "float32", "rfilter": {"type": "box"}}
    return {"type": "hdrfilm", "width": width, "height": height, **pixels}


def _shape(mesh: Any, file: Path) -> dict[str, Any]:
    write_ply(file, mesh)
    return {"type": "ply", "filename": str(file)}


def _grey(value: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(value)] * 3}


def _surroundings(image: NDArray[np.float32]) -> dict[str, Any]:
    """A map by latitude and longitude, z up."""
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": upright}


def _filled(material: Any) -> Any:
    """A material with its colours and images as Mitsuba takes them."""
    if isinstance(material, dict):
        return {key: _filled(value) for key, value in material.items()}
    if not isinstance(material, Painted):
        return material
    if isinstance(material.color, np.ndarray) and material.color.ndim == 3:
        upright = mi.Bitmap(np.ascontiguousarray(material.color[::-1]))  # row 0 at v = 1
        return {"type": "bitmap", "bitmap": upright, "filter_type": "bilinear", "wrap_mode": "clamp"}
    s = np.asarray(material.color, float) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return {"type": "rgb", "value": [float(value) for value in linear]}
