"""rasterization() on parameters drawn from the worst numbers there are."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussian_scenes import assert_finite, random_scene
from thermosplat import rasterization

SPECIAL = st.sampled_from([0.0, -0.0, 1e-45, 1e-20, 1.0, -1.0, 1e4, 1e20, 3e38, float("inf"), float("nan")])


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    where=st.lists(
        st.tuples(st.sampled_from(["means", "quats", "scales", "opacities", "colors"]), st.integers(0, 11), SPECIAL),
        min_size=1,
        max_size=8,
    ),
    rasterize_mode=st.sampled_from(["classic", "antialiased"]),
    eps2d=st.sampled_from([0.0, 0.3]),
)
def test_any_numbers_at_all(where: list[tuple[str, int, float]], rasterize_mode: str, eps2d: float) -> None:
    """Whatever the parameters hold, gradients are finite, and so is the image unless a colour itself is huge."""
    scene = random_scene(n=12, width=9, height=7, rasterize_mode=rasterize_mode, eps2d=eps2d)
    for name, index, value in where:
        if name == "opacities" and 1.0 < value < float("inf"):
            continue  # opacities lie in [0, 1]; only non-finite ones are something else than a caller's mistake
        values = scene[name].view(12, -1)
        values[index, index % values.shape[1]] = value if name != "colors" or not 1e5 < value < 1e39 else 1e5
    assert_finite(rasterization, scene)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(
    seed=st.integers(0, 10_000),
    decades=st.sampled_from([4.0, 16.0, 38.0]),
    rasterize_mode=st.sampled_from(["classic", "antialiased"]),
    camera_model=st.sampled_from(["pinhole", "ortho", "fisheye"]),
    eps2d=st.sampled_from([0.0, 1e-6, 0.3, 1e10]),
    near_plane=st.sampled_from([0.01, 0.0, -1e30]),
    sh_degree=st.sampled_from([None, 2]),
    cameras_too=st.booleans(),
)
def test_magnitudes_of_all_of_float32(
    seed: int,
    decades: float,
    rasterize_mode: str,
    camera_model: str,
    eps2d: float,
    near_plane: float,
    sh_degree: int | None,
    cameras_too: bool,
) -> None:
    """Some parameters multiplied by up to 1e±38, some zero, also in the cameras; colours up to 1e16 or so."""
    scene = random_scene(
        n=12,
        width=9,
        height=7,
        seed=seed,
        rasterize_mode=rasterize_mode,
        camera_model=camera_model,
        eps2d=eps2d,
        near_plane=near_plane,
        far_plane=3e38,
        sh_degree=sh_degree,
    )
    generator = torch.Generator().manual_seed(seed)
    for name in ("means", "quats", "scales", "opacities", "colors", *(["viewmats", "Ks"] if cameras_too else [])):
        value = scene[name]
        most = min(decades, 16.0) if name == "colors" else decades
        factor = 10 ** ((2 * torch.rand(value.shape, generator=generator).double() - 1) * most)
        factor = torch.where(torch.rand(value.shape, generator=generator) < 0.1, 0.0, factor)
        factor = torch.where(torch.rand(value.shape, generator=generator) < 0.25, factor, 1.0)
        largest = 1.0 if name == "opacities" else 3e38
        scene[name] = (value * factor).clamp(-largest, largest).float().double()
    assert_finite(rasterization, scene)
