"""The projection's step: storing gradients is adding them to zeros, and gradients not given are zero."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.projection.plain_camera_step import project_gaussians, project_gaussians_adjoint
from warp_kernels.projection.projection import ProjectedArrays
from warp_kernels.rasterization import allocate_projected
from warp_scene import WarpScene, warp_scene


def projected_scene(given: tuple[str, ...]) -> tuple[WarpScene, ProjectedArrays]:
    """A scene seen by two cameras, with gradients of the outputs that are named."""
    scene = warp_scene(wp.float64, n=50, cameras=2, requires_grad=True)
    scene.gaussians.means.assign(scene.scene["means"].numpy() * 2)  # some out of view
    projected = allocate_projected(100, wp.float64, scene.gaussians.means.device, True)
    project_gaussians(scene.gaussians, scene.settings, projected)
    rng = np.random.default_rng(3)
    for name in ("means2d", "depths", "roots", "compensations"):
        array = getattr(projected, name)
        values = rng.normal(size=array.numpy().shape) * (name in given)
        if name in given or "zeros" in given:
            array.grad.assign(values)
        else:
            array.grad = None
    return scene, projected


@pytest.mark.parametrize("given", [("means2d", "roots"), ("depths",)])
def test_stored_gradients_are_the_added_ones(given: tuple[str, ...]) -> None:
    """Memory that holds anything is overwritten, that of Gaussians nobody sees included."""
    runs = []
    for store, filled in ((False, given), (True, given), (False, (*given, "zeros"))):
        scene, projected = projected_scene(filled)
        g = scene.gaussians
        found = [g.means.grad, g.quats.grad, g.scales.grad]
        if store:
            for gradient in found:
                gradient.fill_(np.nan)
        project_gaussians_adjoint(g, scene.settings, projected, store=store)
        runs.append([gradient.numpy() for gradient in (*found, g.viewmats.grad, g.Ks.grad)])
    unseen = ~projected.visible.numpy().reshape(2, 50).any(0)
    assert 0 < unseen.sum() < 50
    assert (runs[1][0][unseen] == 0).all()
    assert np.linalg.norm(runs[0][0]) > 0
    for other in runs[1:]:
        assert all(np.array_equal(one, two) for one, two in zip(runs[0], other, strict=True))
