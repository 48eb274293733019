"""A walk round the desk with two cameras on one mount: rig_desk."""

import json
import zlib
from pathlib import Path

import numpy as np

from rendered_captures.files.mount import Mount, Variant
from rendered_captures.files.two_cameras import write_two_cameras
from rendered_captures.paths import look_at
from rendered_captures.scenes.desk import desk
from rendered_captures.sensors.lens import Lens

_SCENE_SEED = 7
"""That of the paired capture: it is the same desk."""


def rig_mount(variant: Variant) -> Mount:
    """The desk, the path and the two cameras."""
    seed, views = 11 if variant.seed is None else variant.seed, variant.views or 40
    scene, path = desk(np.random.default_rng([_SCENE_SEED, zlib.crc32(b"desk")]))
    places, targets = path(views, np.random.default_rng([seed, 1]))
    focal = float(800 / (2 * np.tan(np.radians(scene.fov) / 2)))
    return Mount(
        scene,
        [look_at(place, target) for place, target in zip(places, targets, strict=True)],
        Lens(800, 600, focal, 403.0, 297.0, -0.11, 0.03, margin=1.16),
        Lens(320, 240, 0.92 * focal * 320 / 800, 157.5, 122.0, -0.24, 0.07, margin=1.3),
        turn=(-0.9, 1.4, 0.6),
        offset=(0.052, -0.021, 0.012),
        photographs=[f"VIS_{k + 1:04d}.jpg" for k in range(views)],
        thermal_images=[f"IR_{k + 1:04d}.tiff" for k in range(views)],
        samples=(40, 36),
        seeds=(seed,),
        jpeg=93,
    )


def write_rig(variant: Variant, out: Path) -> None:
    """Render the rig's files and truth.json into a folder."""
    truth = write_two_cameras(rig_mount(variant), variant, out)
    (out / "truth.json").write_text(json.dumps({"scene": "desk", **truth}))
