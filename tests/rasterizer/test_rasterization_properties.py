"""What must hold for any scene: order of Gaussians, weights, the two opacities, gradients."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussian_scenes import (
    Scene,
    assert_matches_reference,
    gradients,
    leaves,
    random_rgbt_scene,
    random_scene,
    relative_error,
    upstream_gradients,
)
from thermosplat import rasterization, rasterization_rgbt

FEW = settings(max_examples=12, deadline=None, derandomize=True, database=None)
PER_GAUSSIAN = ("means", "quats", "scales", "opacities", "colors")


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Scenes of 1 to 80 Gaussians in ragged images, with either filter, camera model and tile size."""
    scene = random_scene(
        n=draw(st.integers(1, 80)),
        width=draw(st.integers(1, 40)),
        height=draw(st.integers(1, 40)),
        cameras=draw(st.integers(1, 2)),
        seed=draw(st.integers(0, 10_000)),
        rasterize_mode=draw(st.sampled_from(["classic", "antialiased"])),
        camera_model=draw(st.sampled_from(["pinhole", "ortho", "fisheye"])),
        sh_degree=draw(st.sampled_from([None, 1])),
        tile_size=draw(st.sampled_from([8, 16])),
    )
    factor = draw(st.sampled_from([0.2, 1.0, 3.0]))
    return scene | {"scales": (scene["scales"] * factor).float().double()}


@FEW
@given(scene=scenes(), seed=st.integers(0, 1000))
def test_the_order_of_gaussians_does_not_matter(scene: Scene, seed: int) -> None:
    """Permuted Gaussians give the same image and permuted gradients (no two depths are equal)."""
    n = len(scene["means"])
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    results = []
    for permutation in (torch.arange(n), order):
        permuted = scene | {name: scene[name][permutation] for name in PER_GAUSSIAN}
        inputs = leaves(permuted, "cpu", torch.float64)
        images = rasterization(**inputs)[:2]
        results.append(
            (images, gradients(images, upstream_gradients(images, torch.ones(images[0].shape[:-1])), inputs))
        )
    (images, found), (permuted_images, permuted_found) = results
    for image, other in zip(images, permuted_images, strict=True):
        assert torch.equal(image, other)
    for name, gradient in found.items():
        expected = gradient[order] if name in PER_GAUSSIAN else gradient
        assert relative_error(permuted_found[name], expected) < 1e-11, name


@FEW
@given(scene=scenes())
def test_weights_and_transmittance_sum_to_one(scene: Scene) -> None:
    """Blending the number 1 gives the alpha: Σ w + T = 1, in float32 to its rounding."""
    ones = torch.ones(len(scene["means"]), 1, dtype=torch.float64)
    whole = scene | {"colors": ones, "sh_degree": None, "backgrounds": torch.ones(len(scene["viewmats"]), 1).double()}
    for dtype, tolerance in ((torch.float32, 1e-6), (torch.float64, 1e-14)):
        image, alphas, _ = rasterization(**leaves(whole, "cpu", dtype))
        assert (image - 1).abs().max() < tolerance  # Σ w · 1 + T · 1
        assert ((alphas >= 0) & (alphas <= 1 - 1e-4 + 1e-6)).all()


@FEW
@given(scene=scenes())
def test_equal_opacities_reproduce_the_single_pass(scene: Scene) -> None:
    """With α_t = α both passes are the single one: features equal to the bit, gradients to rounding."""
    features = random_rgbt_scene(n=len(scene["means"]))["features"]
    del scene["backgrounds"]
    inputs = leaves(scene | {"features": features}, "cpu", torch.float64)
    result = rasterization_rgbt(**inputs, thermal_opacities=inputs["opacities"])
    assert torch.equal(result.render_features, result.render_thermal_features)
    assert torch.equal(result.render_alphas, result.render_thermal_alphas)
    both = result.render_colors.sum() + (result.render_features + result.render_thermal_features).square().sum()
    names = ("means", "scales", "opacities", "features", "viewmats")
    found = torch.autograd.grad(both, [inputs[name] for name in names])

    again = leaves(scene | {"features": features}, "cpu", torch.float64)
    colors = rasterization(**{key: value for key, value in again.items() if key != "features"})[0]
    single = {key: value for key, value in again.items() if key != "features"} | {
        "colors": again["features"],
        "sh_degree": None,
    }
    image = rasterization(**single)[0]
    assert torch.equal(image, result.render_features)
    expected = torch.autograd.grad(colors.sum() + (2 * image).square().sum(), [again[name] for name in names])
    for name, one, other in zip(names, found, expected, strict=True):
        assert relative_error(one, other) < 1e-11, name


@FEW
@given(scene=scenes())
def test_float64_kernels_equal_the_reference(scene: Scene) -> None:
    """Image and every gradient of a random scene are the dense reference's."""
    try:
        assert_matches_reference(rasterization, scene, "cpu", torch.float64, gradient_tolerance=1e-9)
    except AssertionError as error:
        if "too many pixels on a threshold" not in str(error):
            raise


@FEW
@given(scene=scenes())
def test_float32_gradients_are_those_of_float64(scene: Scene) -> None:
    """Where no pixel is at a threshold, gradients of a smooth loss differ by rounding only."""
    found = []
    for dtype in (torch.float32, torch.float64):
        inputs = leaves(scene, "cpu", dtype)
        images = rasterization(**inputs)[:2]
        # A loss whose terms do not cancel, so that the relative error says something.
        upstream = [torch.ones(image.shape, dtype=torch.float64) for image in images]
        found.append((images, gradients(images, upstream, inputs)))
    (single, single_gradients), (double, double_gradients) = found
    off = max(float((a.double() - b).detach().abs().max()) for a, b in zip(single, double, strict=True))
    if off > 1e-4:
        return  # a Gaussian drawn in one precision only
    for name in ("means", "scales", "opacities", "colors"):
        truth = double_gradients[name]
        scale = truth.abs().sum().clamp(min=1e-3)
        assert float((single_gradients[name] - truth).abs().sum() / scale) < 1e-4, name


def test_same_bits_on_every_run_and_any_number_of_threads() -> None:
    """On the CPU the image and gradients do not depend on the run or on torch's thread count."""
    scene = random_scene(n=300, width=90, height=70, channels=11, seed=6)
    scene["scales"] = scene["scales"] / 2
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 1, 2):
            torch.set_num_threads(count)
            inputs = leaves(scene, "cpu", torch.float32)
            image, alphas, _ = rasterization(**inputs)
            upstream = upstream_gradients([image, alphas], torch.ones(1, 70, 90))
            results.append([image, alphas, *gradients([image, alphas], upstream, inputs).values()])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
