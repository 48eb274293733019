"""Every render of a model widens footprints as the model was trained."""

import torch

from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.rasterizer import median_depths, project, rasterization
from thermosplat.scene.pixel_filter import PixelFilter
from thermosplat.scene.views import camera_arguments, projection_arguments
from toy_scene import toy_capture, toy_config, toy_model


def test_renders_are_those_of_the_rasterizer_with_the_same_arguments() -> None:
    """SH colours of a model without features, and depth."""
    capture, chosen = toy_capture(), PixelFilter(eps2d=0.05)
    model = toy_model(toy_config(**chosen._asdict(), feature_dim=0), capture)
    view = frame_tensors(capture.train[0], capture.scales, "cpu").views["rgb"]
    gaussians = model.gaussians(model.set_of("rgb"))
    arguments = {"packed": False, **camera_arguments(view), **chosen._asdict()}
    shape = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    with torch.no_grad():
        image, _, _ = rasterization(*shape, gaussians.sh_coeffs_of("rgb"), sh_degree=1, **arguments)
        depth, _, _ = rasterization(*shape, gaussians.opacities[:, None], render_mode="ED", **arguments)
        found = model.render({"rgb": view}, sh_degree=1).images["rgb"]
        torch.testing.assert_close(found, image[0], rtol=0, atol=1e-6)
        expected = model.render_depth("rgb", view, expected=True)
        torch.testing.assert_close(expected, depth[0, ..., 0], rtol=0, atol=1e-6)
        median = median_depths(project(*shape, **projection_arguments(view), **chosen._asdict()))[0]
        assert torch.equal(model.render_depth("rgb", view), median)
        usual = toy_model(toy_config(feature_dim=0), capture)
        assert (usual.render({"rgb": view}, sh_degree=1).images["rgb"] - found).abs().max() > 1e-3
