"""rasterization() on parameters drawn from the worst numbers there are."""

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
