"""The projection kernel's outputs, one by one, against the dense reference's projection."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

import reference_projection
from warp_scene import WarpScene, projected, warp_scene


def reference_of(scene: WarpScene) -> reference_projection.ProjectedGaussians:
    """The scene's projection by the reference, in the settings' mode."""
    s, settings = scene.scene, scene.settings
    return reference_projection.project(
        *reference_projection.flat_scene(s["means"], s["quats"], s["scales"], None, s["viewmats"], s["Ks"]),
        s["opacities"][None, None],
        torch.ones(1, 1, settings.num_gaussians, dtype=torch.bool),
        s["width"],
        s["height"],
        near_plane=0.01,
        far_plane=1e10,
        radius_clip=0.0,
        eps2d=0.3,
        antialiased=settings.antialiased,
        camera_model=settings.camera_model,
    )


@pytest.mark.parametrize(("dtype", "tolerance"), [(wp.float32, 2e-6), (wp.float64, 1e-12)])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("camera_model", ["pinhole", "ortho", "fisheye"])
def test_equals_reference(camera_model: str, antialiased: bool, dtype: type, tolerance: float) -> None:
    """Who is visible, and of those means2d, depths, roots of conics, compensations and extents."""
    scene = warp_scene(dtype, n=120, cameras=2, camera_model=camera_model, seed=4)
    scene.settings = replace(scene.settings, camera_model=camera_model, antialiased=antialiased)
    scene.scene["means"][::5] *= 4  # some out of view
    scene.gaussians.means.assign(scene.scene["means"].numpy())
    found = projected(scene)
    s, truth = scene.scene, reference_of(scene)
    visible = truth.visible.flatten().numpy()
    assert 0.4 < visible.mean() < 0.98
    assert (found.visible.numpy() == visible).all()
    pairs = [
        (found.means2d, truth.means2d),
        (found.depths, truth.depths),
        (found.roots, conic_roots(truth.conics)),
        (found.compensations, truth.compensations),
    ]
    for array, expected in pairs:
        values, expected = array.numpy(), expected.flatten(0, 2).numpy()
        assert array is not found.compensations or (values[~visible] == 0).all()
        error = np.linalg.norm(values[visible] - expected[visible]) / np.linalg.norm(expected[visible])
        assert error < tolerance
    extents = found.extents.numpy()[visible]
    assert (np.ceil(extents) == truth.radii.reshape(-1, 2).numpy()[visible]).all()
    # Half the bounding box of the ellipse alpha = 1/255: 2 ln(255 o) = extent² / variance.
    variance = np.linalg.inv(conic_matrices(truth.conics.reshape(-1, 3).numpy()[visible]))[:, [0, 1], [0, 1]]
    opacity = (s["opacities"][None] * truth.compensations[0]).reshape(-1).numpy()[visible]
    expected = np.minimum(3.33, np.sqrt(2 * np.log(255 * opacity)))[:, None] * np.sqrt(variance)
    assert np.abs(extents / expected - 1).max() < 100 * tolerance


def conic_matrices(conics: np.ndarray) -> np.ndarray:
    """[n, 3] (xx, xy, yy) as [n, 2, 2]."""
    return conics[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def conic_roots(conics: torch.Tensor) -> torch.Tensor:
    """(u, k, v) of [..., 3] conics; zeros stay zeros."""
    a, b, c = conics.unbind(-1)
    return torch.stack([a.sqrt(), torch.nan_to_num(b / a), torch.nan_to_num((c - b * b / a).sqrt())], -1)


def test_roots_of_needles_do_not_cancel() -> None:
    """In float32 a needle 1000 times longer than wide keeps both its axes to rounding: no xx·yy - xy·xy."""
    scenes = [warp_scene(dtype, n=40) for dtype in (wp.float32, wp.float64)]
    lengths = []
    for scene in scenes:
        scales = scene.gaussians.scales.numpy()
        scales[:] = (2.0, 0.002, 0.002)
        scene.gaussians.scales.assign(scales.astype(np.float32))
        u, k, v = projected(scene).roots.numpy().astype(np.float64).T
        visible = u > 0
        matrices = np.stack([u, u * k, 0 * u, v], -1).reshape(-1, 2, 2)[visible]
        lengths.append(np.linalg.svd(matrices, compute_uv=False))  # 1 / standard deviations
    assert len(lengths[0]) == len(lengths[1]) > 20
    assert (lengths[1][:, 0] / lengths[1][:, 1]).max() > 10
    assert np.abs(lengths[0] / lengths[1] - 1).max() < 2e-6


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
@pytest.mark.parametrize("case", ["around", "far from the origin", "beside the image", "askew", "tiny and huge"])
def test_nothing_is_culled_that_reaches_the_image(case: str, camera_model: str, dtype: type) -> None:
    """The rough test in front says no only where the exact one does: Gaussians on all sides of hard cameras."""
    n, cameras = 3000, 2
    scene = warp_scene(dtype, n=n, cameras=cameras, camera_model=camera_model, seed=5)
    scene.settings = replace(scene.settings, camera_model=camera_model)
    s, rng = scene.scene, torch.Generator().manual_seed(7)
    s["means"] = 4.0 * torch.randn(n, 3, generator=rng, dtype=torch.float64)
    if case == "far from the origin":
        s["means"] += 3e4
        s["viewmats"][:, :3, 3] -= s["viewmats"][:, :3, :3] @ torch.full((3,), 3e4, dtype=torch.float64)
    if case == "beside the image":
        s["Ks"][:, 0, 2] = torch.tensor([-2.5, 3.0], dtype=torch.float64) * s["width"]
        s["Ks"][:, 1, 1] *= 3.0
    if case == "askew":
        s["viewmats"][:, :3, :3] @= torch.eye(3, dtype=torch.float64) + 0.8 * torch.rand(3, 3, generator=rng)
        s["Ks"][:, 0, 0] *= -1.0
    if case == "tiny and huge":
        s["scales"] = 10 ** (6.0 * torch.rand(n, 3, generator=rng, dtype=torch.float64) - 4.0)
    given = {name: s[name].numpy() for name in ("means", "scales", "viewmats", "Ks")}
    for name, values in given.items():
        getattr(scene.gaussians, name).assign(values)
        s[name] = torch.from_numpy(getattr(scene.gaussians, name).numpy()).double()  # as the kernel reads them
    truth = reference_of(scene)
    sure = ~truth.marginal.flatten().numpy()
    visible = truth.visible.flatten().numpy()
    assert 0.01 < visible.mean() < 0.99
    assert sure.mean() > 0.95
    assert (projected(scene).visible.numpy() == visible)[sure].all()
