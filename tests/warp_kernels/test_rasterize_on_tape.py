"""warp_kernels alone, on a Warp tape of the user's own, without torch in the loop."""

import dataclasses
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from gaussian_scenes import gradients, leaves
from thermosplat import rasterization, rasterization_rgbt
from warp_kernels.rasterization import Rasterization, rasterize
from warp_scene import WarpScene, warp_scene


def test_imports_neither_torch_nor_thermosplat() -> None:
    """Every module of warp_kernels works where torch is not installed."""
    code = (
        "import sys, pkgutil, importlib; sys.modules['torch'] = None; sys.modules['thermosplat'] = None\n"
        "import warp_kernels\n"
        "names = [m.name for m in pkgutil.iter_modules(warp_kernels.__path__)]\n"
        "[importlib.import_module('warp_kernels.' + name) for name in names]\n"
        "assert len(names) > 8, names"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=None, check=False)
    assert done.returncode == 0, done.stderr


def upstream(result: Rasterization, thermal: bool) -> list[np.ndarray]:
    """Sets and returns random gradients of the images."""
    rng = np.random.default_rng(3)
    images = [result.blended.render, result.blended.transmittance]
    if thermal:
        images += [result.blended.thermal_render, result.blended.thermal_transmittance]
    values = [rng.normal(size=image.numpy().shape) for image in images]
    for image, value in zip(images, values, strict=True):
        image.grad.assign(value)
    return values


def torch_gradients(scene: WarpScene, values: list[np.ndarray], extra: dict[str, Any]) -> dict[str, torch.Tensor]:
    """The same gradients through torch; transmittance is 1 - alpha."""
    inputs = leaves(scene.scene | extra, "cpu", torch.float64)
    if extra:
        inputs["colors"], inputs["features"] = inputs["colors"][:, :3], inputs["colors"][:, 3:]
        result = rasterization_rgbt(**inputs)
        images = [torch.cat([result.render_colors, result.render_features], -1), result.render_alphas]
        images += [result.render_thermal_features, result.render_thermal_alphas]
    else:
        images = list(rasterization(**inputs)[:2])
    tensors = [torch.from_numpy(value).reshape(image.shape) for image, value in zip(images, values, strict=True)]
    tensors[1::2] = [-tensor for tensor in tensors[1::2]]
    del inputs["colors"]
    inputs.pop("features", None)
    return gradients(images, tensors, inputs)


@pytest.mark.parametrize("thermal", [False, True])
def test_gradients_equal_torchs(thermal: bool) -> None:
    """A frame rendered and differentiated on a wp.Tape equals the torch path, one opacity or two."""
    arguments = {"n": 50, "width": 37, "height": 21, "channels": 5 if thermal else 3, "backgrounds": False}
    scene = warp_scene(wp.float64, requires_grad=True, **arguments)
    extra = {}
    g = scene.gaussians
    if thermal:
        extra["thermal_opacities"] = scene.scene["opacities"].flip(0)
        g.thermal_opacities = wp.array(
            extra["thermal_opacities"].numpy(), dtype=wp.float64, device="cpu", requires_grad=True
        )
    tape = wp.Tape()
    result = rasterize(g, scene.features, scene.settings, tape, thermal_channels=2 if thermal else 0)
    truth = torch_gradients(scene, upstream(result, thermal), extra)
    tape.backward()
    found = {
        "means": g.means,
        "quats": g.quats,
        "scales": g.scales,
        "opacities": g.opacities,
        "viewmats": g.viewmats,
        "Ks": g.Ks,
    }
    if thermal:
        found["thermal_opacities"] = g.thermal_opacities
    for name, array in found.items():
        gradient, expected = array.grad.numpy(), truth[name].numpy()
        assert np.linalg.norm(expected) > 0
        assert np.linalg.norm(gradient - expected) < 1e-11 * np.linalg.norm(expected), name


def test_tape_can_be_zeroed_and_replayed() -> None:
    """tape.zero() clears every gradient, so that a second backward gives the same numbers again."""
    scene = warp_scene(wp.float64, n=30, requires_grad=True)
    g = scene.gaussians
    tape = wp.Tape()
    result = rasterize(g, scene.features, scene.settings, tape)
    arrays = [g.means, g.quats, g.scales, g.opacities, g.viewmats, g.Ks, scene.features]
    runs = []
    for _ in range(2):
        upstream(result, False)
        tape.backward()
        runs.append([array.grad.numpy().copy() for array in arrays])
        tape.zero()
        assert all((array.grad.numpy() == 0).all() for array in arrays)
    assert all((one == other).all() for one, other in zip(*runs, strict=True))


def test_without_a_tape() -> None:
    """Inference needs no gradients and gives the same image."""
    scene = warp_scene(n=30)
    image = rasterize(scene.gaussians, scene.features, scene.settings).blended.render.numpy()
    taped = warp_scene(n=30, requires_grad=True)
    same = rasterize(taped.gaussians, taped.features, taped.settings, wp.Tape()).blended.render.numpy()
    assert (image == same).all()
    expected, _, _ = rasterization(**leaves(scene.scene | {"backgrounds": None}, "cpu", torch.float32))
    assert np.abs(image - expected[0].detach().numpy()).max() < 1e-6


@pytest.mark.parametrize("wrong", ["num_gaussians", "num_cameras", "num_images"])
def test_numbers_of_settings_are_the_arrays(wrong: str) -> None:
    """More than there are would be read, and written, from memory of others."""
    scene = warp_scene(n=5)
    settings = dataclasses.replace(scene.settings, **{wrong: 6})
    with pytest.raises(ValueError, match="num_gaussians = 5"):
        rasterize(scene.gaussians, scene.features, settings)
    with pytest.raises(ValueError, match="got 3"):
        rasterize(scene.gaussians, scene.features[:3], scene.settings)


def test_what_the_shortcut_does_not_do() -> None:
    """Several images are the steps' business; the message says so."""
    scene = warp_scene(n=5, cameras=2)
    with pytest.raises(ValueError, match="one image"):
        rasterize(scene.gaussians, scene.features, scene.settings)


def test_a_tape_of_no_gaussians() -> None:
    """The image is empty, and what lies before the render on the tape gets gradients of zero."""
    scene = warp_scene(n=0, requires_grad=True, backgrounds=False)
    tape = wp.Tape()
    result = rasterize(scene.gaussians, scene.features, scene.settings, tape)
    assert (result.blended.transmittance.numpy() == 1).all()
    upstream(result, False)
    tape.backward()
    assert (scene.gaussians.viewmats.grad.numpy() == 0).all()
    tape.zero()
    assert (result.blended.render.grad.numpy() == 0).all()
