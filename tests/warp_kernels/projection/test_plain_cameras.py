"""The fisheye camera without a lens: on its axis, around it, and at every angle, against plain torch in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

import reference_projection
from warp_kernels.projection.plain_camera_step import project_gaussians, project_gaussians_adjoint
from warp_kernels.projection.plain_cameras import NEAR_AXIS
from warp_kernels.projection.projection import ProjectedArrays
from warp_kernels.rasterization import allocate_projected
from warp_scene import WarpScene, warp_scene


def seen(points: torch.Tensor) -> tuple[WarpScene, ProjectedArrays]:
    """Gaussians at points [n, 3] before a fisheye camera of 60 px a radian, with random gradients to the outputs."""
    scene = warp_scene(wp.float64, n=len(points), requires_grad=True, camera_model="fisheye", seed=4)
    scene.settings = replace(scene.settings, camera_model="fisheye", width=240, height=240)
    s = scene.scene
    s["means"], s["viewmats"] = points, torch.eye(4, dtype=torch.float64)[None]
    s["Ks"] = torch.tensor([[[60.0, 0.0, 120.0], [0.0, 55.0, 120.0], [0.0, 0.0, 1.0]]], dtype=torch.float64)
    s["opacities"] = torch.full_like(s["opacities"], 0.9)
    for name in ("means", "viewmats", "Ks", "opacities"):
        getattr(scene.gaussians, name).assign(s[name].numpy())
    projected = allocate_projected(len(points), wp.float64, scene.gaussians.means.device, True)
    project_gaussians(scene.gaussians, scene.settings, projected)
    assert projected.visible.numpy().all()
    rng = np.random.default_rng(3)
    for array in (projected.means2d, projected.depths, projected.roots):
        row = rng.normal(size=array.numpy().shape[1:])
        array.grad.assign(np.broadcast_to(row, array.numpy().shape).copy())  # the same for all
    project_gaussians_adjoint(scene.gaussians, scene.settings, projected)
    return scene, projected


def expected(scene: WarpScene, projected: ProjectedArrays) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """The reference's means and roots, and its gradients to means, quats, scales, the view and intrinsics."""
    s = {name: scene.scene[name].requires_grad_() for name in ("means", "quats", "scales", "viewmats", "Ks")}
    truth = reference_projection.project(
        *reference_projection.flat_scene(s["means"], s["quats"], s["scales"], None, s["viewmats"], s["Ks"]),
        scene.scene["opacities"][None, None],
        torch.ones(1, 1, len(s["means"]), dtype=torch.bool),
        240,
        240,
        near_plane=0.01,
        far_plane=1e10,
        radius_clip=0.0,
        eps2d=0.3,
        antialiased=False,
        camera_model="fisheye",
    )
    a, b, c = truth.conics[0, 0].unbind(-1)
    roots = torch.stack([a.sqrt(), b / a, (c - b * b / a).sqrt()], -1)
    outputs = [truth.means2d[0, 0], truth.depths[0, 0], roots]
    given = [torch.from_numpy(array.grad.numpy()) for array in (projected.means2d, projected.depths, projected.roots)]
    return outputs, list(torch.autograd.grad(outputs, list(s.values()), given))


def test_every_angle() -> None:
    """Positions, roots and all gradients from 0.05 to 1.5 rad off the axis, and on both sides of NEAR_AXIS."""
    angles = torch.cat([torch.linspace(0.05, 1.5, 30), NEAR_AXIS**0.5 * torch.tensor([0.5, 0.999, 1.001])]).double()
    turns = torch.linspace(0.0, 40.0, len(angles)).double()
    points = torch.stack([angles.sin() * turns.cos(), angles.sin() * turns.sin(), angles.cos()], -1)
    scene, projected = seen(points * torch.linspace(2.0, 6.0, len(angles)).double()[:, None])
    outputs, gradients = expected(scene, projected)
    g = scene.gaussians
    pairs = zip((projected.means2d, projected.depths, projected.roots), outputs, strict=True)
    for array, truth in pairs:
        np.testing.assert_allclose(array.numpy(), truth.detach().numpy(), rtol=1e-12, atol=1e-12)
    for array, truth in zip((g.means, g.quats, g.scales, g.viewmats, g.Ks), gradients, strict=True):
        found = array.grad.numpy()
        assert np.linalg.norm(found - truth.numpy()) < 1e-9 * np.linalg.norm(truth.numpy())


def test_the_axis_is_no_exception() -> None:
    """The gradient to a mean on the axis is the limit of those beside it."""
    beside = torch.tensor([0.0, 1e-30, 1e-12, 1e-6, 1e-4], dtype=torch.float64)
    points = torch.stack([0.6 * beside, -0.8 * beside, torch.full_like(beside, 3.0)], -1)
    found = []
    for point in points:  # the same Gaussian at each
        one, projected = seen(point[None])
        found.append(one.gaussians.means.grad.numpy()[0])
        assert np.isfinite(projected.roots.numpy()).all()
    assert np.abs(found[0]).min() > 1e-3
    for other, distance in zip(found[1:], beside[1:].tolist(), strict=True):
        np.testing.assert_allclose(other, found[0], rtol=1e-9 + 100 * distance)


@pytest.mark.parametrize("point", [[0.0, 0.0, -3.0], [0.0, 0.0, 0.0]])
def test_where_no_image_is_nothing_is_drawn(point: list[float]) -> None:
    """Behind the camera on its axis, and in its centre, with a near plane behind both."""
    scene = warp_scene(wp.float32, n=1, camera_model="fisheye")
    scene.settings = replace(scene.settings, camera_model="fisheye", near_plane=-10.0)
    scene.gaussians.means.assign(np.array([point], dtype=np.float32))
    scene.gaussians.viewmats.assign(np.eye(4, dtype=np.float32)[None])
    projected = allocate_projected(1, wp.float32, scene.gaussians.means.device, False)
    project_gaussians(scene.gaussians, scene.settings, projected)
    assert not projected.visible.numpy().any()
