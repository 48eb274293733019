"""torch.compile on a model that calls the rasterizer: a graph break around it, and the same gradients."""

import shutil

import pytest
import torch
from torch import Tensor, nn

from gaussian_scenes import random_scene, relative_error
from thermosplat import rasterization


class DecodedScene(nn.Module):
    """Gaussians with stored activations before the rasterizer and a layer per pixel after it."""

    def __init__(self) -> None:
        super().__init__()
        scene = random_scene(n=40, channels=4, backgrounds=False)
        self.camera = [scene["viewmats"].float(), scene["Ks"].float(), scene["width"], scene["height"]]
        self.means = nn.Parameter(scene["means"].float())
        self.quats = nn.Parameter(scene["quats"].float())
        self.log_scales = nn.Parameter(scene["scales"].float().log())
        self.logit_opacities = nn.Parameter(torch.logit(scene["opacities"].float()))
        self.features = nn.Parameter(scene["colors"].float())
        torch.manual_seed(0)
        self.decoder = nn.Linear(4, 3)

    def forward(self) -> Tensor:
        """The decoded image."""
        image, _, _ = rasterization(
            self.means,
            self.quats,
            self.log_scales.exp(),
            self.logit_opacities.sigmoid(),
            self.features * 2.0,
            *self.camera,
        )
        return torch.sigmoid(self.decoder(image))


def test_compiled_model_has_the_gradients_of_the_eager_one() -> None:
    """Loss and the gradient of every parameter."""
    if shutil.which("g++") is None and shutil.which("clang++") is None:
        pytest.skip("torch.compile needs a C++ compiler; neither g++ nor clang++ is on the PATH")
    results = []
    for compiled in (False, True):
        torch._dynamo.reset()
        model = DecodedScene()
        forward = torch.compile(model) if compiled else model
        for _ in range(2):  # the second call runs what the first compiled
            model.zero_grad()
            image = forward()
            image.square().sum().backward()
        results.append((image.detach(), {name: value.grad for name, value in model.named_parameters()}))
    (eager, expected), (image, found) = results
    assert torch.allclose(image, eager, atol=1e-6)
    for name, gradient in expected.items():
        assert gradient.norm() > 0, name
        assert relative_error(found[name], gradient) < 1e-5, name
