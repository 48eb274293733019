"""Images of COLMAP's FOV cameras are trained on as they were taken."""

from pathlib import Path

import numpy as np
import pycolmap
import torch

from thermosplat.datasets.cameras import LensCoefficients
from thermosplat.datasets.frame_tensors import ViewTensors, lens_tensor
from thermosplat.datasets.lens import Lens, camera_through_lens
from thermosplat.rasterizer import rasterization
from thermosplat.scene.lens_slopes import bent, straightened
from toy_run import many_frames, through, toy_run_config, toy_trainer
from toy_scene import toy_capture

PARAMS = (60.0, 61.0, 32.0, 24.0, 0.9)


def test_points_are_seen_where_colmap_sees_them() -> None:
    """By kernels, whose gradient is that of differences, and by slopes, whose inverse leads back."""
    camera = camera_through_lens(Lens("FOV", PARAMS, 64, 48), 64, 48)
    points = np.random.default_rng(1).uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 1.1], (50, 3))
    expected = pycolmap.Camera(model="FOV", params=PARAMS, width=64, height=48).img_from_cam(points)
    K, pose = torch.from_numpy(camera.K), torch.eye(4, dtype=torch.float64)
    view = ViewTensors(pose, K, 64, 48, lens=lens_tensor(camera, "cpu").double(), lens_model="fov")
    slopes = torch.from_numpy(points[:, :2] / points[:, 2:])
    np.testing.assert_allclose(bent(slopes, view) * K.diagonal()[:2] + K[:2, 2], expected, atol=1e-4)
    torch.testing.assert_close(straightened(bent(slopes, view), view), slopes, atol=1e-6, rtol=0)

    def seen(omega: torch.Tensor) -> torch.Tensor:
        means = torch.from_numpy(points)
        quats, ones = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(50, 1), torch.ones_like(means)
        where = dict(viewmats=pose[None], Ks=K[None], width=64, height=48, packed=False)
        seen_by = dict(camera_model="fov", radial_coeffs=omega[None, None])
        _, _, info = rasterization(means, quats, 1e-6 * ones, 0.5 * ones[:, 0], ones, **where, **seen_by)
        return info["means2d"][0]

    omega = torch.tensor(PARAMS[-1], dtype=torch.float64, requires_grad=True)
    places = seen(omega)
    np.testing.assert_allclose(places.detach(), expected, atol=1e-6)
    (gradient,) = torch.autograd.grad(places[:, 0].square().sum(), omega)
    above, below = (seen(omega.detach() + step)[:, 0].square().sum() for step in (1e-5, -1e-5))
    torch.testing.assert_close(gradient, (above - below) / 2e-5, rtol=1e-5, atol=0)


def test_training_through_it(tmp_path: Path) -> None:
    """Two steps."""
    lens = LensCoefficients("fov", (0.9, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0))
    capture = through(many_frames(toy_capture()), {"rgb": lens, "thermal": lens})
    toy_trainer(tmp_path, toy_run_config(2), capture).train()
