"""What the kernels of one variant of the blending have in common."""

import warp as wp

from warp_kernels.blending.blend_layout import BlendLayout
from warp_kernels.blending.blend_variant import blend_variant

CPU, CUDA = BlendLayout(16, 16, 16, 1), BlendLayout(16, 8, 8, 32, 256)


def test_the_same_arguments_give_the_same_variant() -> None:
    """So that kernels are found by it; equal layouts are the same argument."""
    variant = blend_variant(11, 8, wp.float32, CPU, 3)
    assert blend_variant(11, 8, wp.float32, BlendLayout(16, 16, 16, 1), 3) is variant
    assert blend_variant(11, 8, wp.float32, CPU) is not variant
    assert blend_variant(11, 8, wp.float32, CPU).first_channels == 11


def test_types_follow_channels_and_pixels() -> None:
    """A vector of nothing is no type of Warp's: what is not there has one number."""
    variant = blend_variant(11, 8, wp.float64, CPU, 3)
    lengths = {name: kind._length_ for name, kind in variant.types._asdict().items() if name.startswith("vec")}
    assert lengths == {"vec2": 2, "vec3": 3, "vec4": 4} | {
        "vecC": 11, "vecD": 8, "vecA": 3, "vecB": 8, "vecQ": 16, "vecP": 256, "vecPi": 256,
    }  # fmt: skip
    assert variant.types.matCP._shape_ == (11, 256)
    single = blend_variant(3, 0, wp.float32, CUDA)
    assert (single.types.vecD._length_, single.types.vecB._length_) == (1, 1)
    assert single.types.vecQ._length_ == single.pixels == 2
    assert (variant.dual, variant.cuda, single.dual, single.cuda) == (True, False, False, True)


def test_a_state_holds_light_and_colours() -> None:
    """Of one opacity or of two; see ``state_length``."""
    one, two = blend_variant(3, 0, wp.float32, CUDA), blend_variant(11, 8, wp.float32, CUDA)
    assert (one.state_length, one.first_behind) == (1 + 3, 1)
    assert (two.state_length, two.first_behind, two.first_behind_thermal) == (2 + 11 + 8, 2, 2 + 11)


def test_kernels_have_names_of_their_own() -> None:
    """Whatever makes their code differ is in the name."""
    variants = [
        blend_variant(*arguments)
        for arguments in [
            (11, 8, wp.float32, CPU), (11, 8, wp.float32, CPU, 3), (11, 0, wp.float32, CPU),
            (11, 8, wp.float64, CPU), (11, 8, wp.float32, CUDA),
        ]
    ]  # fmt: skip
    assert len({variant.name("blend") for variant in variants}) == len(variants)
    assert variants[0].name("join", of_arrays=False) == variants[1].name("join", of_arrays=False)
