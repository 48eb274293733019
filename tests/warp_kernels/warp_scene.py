"""A scene as Warp arrays, for tests that use warp_kernels without torch."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from gaussian_scenes import random_scene
from warp_kernels.projection import GaussianArrays, ProjectedArrays, ProjectionSettings
from warp_kernels.projection_step import project
from warp_kernels.rasterization import allocate_projected


@dataclass
class WarpScene:
    """What the steps of warp_kernels take."""

    gaussians: GaussianArrays
    features: wp.array  # vecC [images · N]
    settings: ProjectionSettings
    scene: dict[str, Any]  # the same as torch tensors


def warp_scene(
    dtype: type = wp.float32, *, device: str = "cpu", requires_grad: bool = False, **arguments: Any
) -> WarpScene:
    """A random scene (see gaussian_scenes) without batch dimensions; colours are shared by the cameras."""
    scene = random_scene(**arguments)
    n, cameras = len(scene["means"]), len(scene["viewmats"])

    def array(values: Any, kind: type) -> wp.array:
        return wp.array(np.asarray(values), dtype=kind, device=device, requires_grad=requires_grad)

    vector, matrix = wp.types.vector, wp.types.matrix
    opacities = array(scene["opacities"], dtype)
    gaussians = GaussianArrays(
        array(scene["means"], vector(3, dtype)),
        array(scene["quats"], vector(4, dtype)),
        array(scene["scales"], vector(3, dtype)),
        None,
        opacities,
        opacities,
        array(scene["viewmats"], matrix((4, 4), dtype)),
        array(scene["Ks"], matrix((3, 3), dtype)),
    )
    colors = scene["colors"].expand(cameras, *scene["colors"].shape).flatten(0, 1)
    settings = ProjectionSettings(
        width=scene["width"], height=scene["height"], num_gaussians=n, num_cameras=cameras, num_images=cameras
    )
    return WarpScene(gaussians, array(colors, vector(colors.shape[-1], dtype)), settings, scene)


def projected(scene: WarpScene, tape: wp.Tape | None = None) -> ProjectedArrays:
    """The scene's projection."""
    device, dtype = scene.gaussians.means.device, scene.gaussians.opacities.dtype
    entries = scene.settings.num_images * scene.settings.num_gaussians
    arrays = allocate_projected(entries, dtype, device, tape is not None)
    project(scene.gaussians, scene.settings, arrays, tape)
    return arrays


def image_opacities(scene: WarpScene, opacities: wp.array) -> wp.array:
    """Opacities [N] repeated for every camera, [images · N], with a gradient."""
    repeated = np.tile(opacities.numpy(), scene.settings.num_images)
    return wp.array(repeated, dtype=opacities.dtype, device=opacities.device, requires_grad=True)
