"""The deal of pixels to lanes: it covers a tile, and is the one that was measured best."""

from types import SimpleNamespace

import pytest
import warp as wp

from warp_kernels.blending.blend_layout import BlendLayout, default_layout

cuda = SimpleNamespace(is_cuda=True)


@pytest.mark.parametrize("tile_size", [8, 16, 32])
@pytest.mark.parametrize("on_cuda", [False, True])
@pytest.mark.parametrize("channels", [3, 19, 32])
@pytest.mark.parametrize("pairs_a_tile", [10, 1000])
def test_lanes_share_out_the_tile(tile_size: int, on_cuda: bool, channels: int, pairs_a_tile: int) -> None:
    """Every pixel has its lane, and blocks of pixels fill the tile."""
    device = cuda if on_cuda else SimpleNamespace(is_cuda=False)
    layout = default_layout(device, tile_size, channels, 0, wp.float32, pairs_a_tile * 8160, 8160)
    assert layout.threads * layout.rows * layout.columns == tile_size**2
    assert layout.block_width * layout.block_height * layout.warps == tile_size**2
    assert layout.lanes * layout.rows * layout.columns == layout.block_width * layout.block_height


@pytest.mark.parametrize(
    ("tiles", "pairs", "thermal_channels", "segment"),
    [
        pytest.param(1200, 369_000, 0, 0, id="garden x1 640x480"),
        pytest.param(1200, 1_357_000, 0, 512, id="garden x25 640x480"),
        pytest.param(475, 481_000, 8, 256, id="desk 400x300"),
        pytest.param(1200, 4_195_000, 0, 1024, id="garden x121 640x480"),
        pytest.param(1200, 688_000, 0, 1024, id="huge 640x480"),
        pytest.param(4346, 843_000, 0, 0, id="garden x1 1297x840"),
        pytest.param(4346, 2_179_000, 0, 1024, id="garden x25 1297x840"),
        pytest.param(4346, 2_219_000, 8, 0, id="garden x25 1297x840, two opacities"),
        pytest.param(5120, 2_900_000, 8, 0, id="a million at random 1280x1024, two opacities"),
        pytest.param(4346, 5_392_000, 8, 1024, id="garden x121 1297x840, two opacities"),
        pytest.param(4346, 5_321_000, 0, 1024, id="garden x121 1297x840"),
        pytest.param(8160, 6_584_000, 0, 0, id="garden x121 1920x1080"),
        pytest.param(32_400, 12_724_000, 0, 0, id="garden x121 3840x2160"),
    ],
)
def test_lists_are_cut_where_the_longest_would_decide(
    tiles: int, pairs: int, thermal_channels: int, segment: int
) -> None:
    """The frames of benchmarks/notes/blending.md."""
    assert default_layout(cuda, 16, 3, thermal_channels, wp.float32, pairs, tiles).segment == segment


def test_tag_names_what_is_compiled() -> None:
    """Layouts of different kernels have different tags; the segment is an argument of the same kernel."""
    layouts = [
        BlendLayout(16, 8, 4, 32),
        BlendLayout(16, 8, 8, 32),
        BlendLayout(16, 16, 16, 1),
        BlendLayout(8, 8, 4, 32),
    ]
    assert len({layout.tag for layout in layouts}) == len(layouts)
    assert BlendLayout(16, 8, 4, 32, 512).tag == layouts[0].tag
