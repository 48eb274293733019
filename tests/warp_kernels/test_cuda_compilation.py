"""Every kernel compiles for CUDA, on machines without a GPU too."""

from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import pytest
import warp as wp

from compilation_for_cuda import ARCHITECTURES, ENDS, compile_all
from warp_kernels.binning.tile_binning import binning_kernels
from warp_kernels.binning.tile_ranges import fill_room_kernel, tile_ranges_kernel
from warp_kernels.blending.blend_layout import BlendLayout, default_layout
from warp_kernels.blending.blend_variant import blend_variant
from warp_kernels.blending.blending import blend_kernel
from warp_kernels.blending.blending_adjoint import blend_adjoint_kernel
from warp_kernels.blending.gradient_records import distribute_kernel, finish_moments_kernel
from warp_kernels.blending.list_segments import deal_states_kernel, join_segments_kernel
from warp_kernels.blending.median_depth import median_depth_kernel
from warp_kernels.blending.ray_blending import RayVariant, ray_blend_adjoint_kernel, ray_blend_kernel
from warp_kernels.blending.segment_light import segment_light_kernel
from warp_kernels.color.camera_positions import camera_position_kernels
from warp_kernels.color.harmonic_basis import ALL
from warp_kernels.color.spherical_harmonics import ColorVariant, color_adjoint_kernel, color_kernel
from warp_kernels.decoding.decoder_adjoint import decode_adjoint_kernel
from warp_kernels.decoding.decoder_memory import INPUTS, TEAMS
from warp_kernels.decoding.decoder_networks import HIDDEN, decode_kernel
from warp_kernels.machinery.strand_sums import strand_sum_kernel
from warp_kernels.projection.affine_camera_adjoint import affine_camera_adjoint_kernel
from warp_kernels.projection.affine_cameras import affine_camera_kernel
from warp_kernels.projection.camera_gradients import (
    CAMERA_RECORD,
    ROLLING_RECORD,
    STILL_RECORD,
    camera_finish_kernel,
    lens_finish_kernel,
)
from warp_kernels.projection.lens_limits import lens_limit_kernel
from warp_kernels.projection.lens_models import LensModel
from warp_kernels.projection.motion_step import motion_kernels
from warp_kernels.projection.projection import projection_kernel
from warp_kernels.projection.projection_adjoint import projection_adjoint_kernel
from warp_kernels.training.activations import activation_kernels

pytestmark = pytest.mark.rotating


def gaussian_kernels(dtype: type) -> list[wp.Kernel]:
    """Kernels with one thread per Gaussian, pair or image."""
    kernels = [
        projection_kernel(dtype, camera_model, from_covars)
        for camera_model in ("pinhole", "ortho", "fisheye")
        for from_covars in (False, True)
    ]
    kernels += [
        projection_adjoint_kernel(dtype, camera_model, from_covars, to_cameras, antialiased)
        for camera_model in ("pinhole", "ortho", "fisheye")
        for from_covars in (False, True)
        for to_cameras in (False, True)
        for antialiased in (False, True)
    ]
    kernels += [projection_adjoint_kernel(dtype, "pinhole", False, posed, False, True) for posed in (False, True)]
    kernels += [
        *binning_kernels(dtype, 32),
        fill_room_kernel,
        tile_ranges_kernel,
        deal_states_kernel,
        camera_finish_kernel(dtype),
    ]
    kernels.append(finish_moments_kernel(dtype))
    kernels += activation_kernels(dtype)
    kernels += [strand_sum_kernel(dtype, 3), strand_sum_kernel(wp.float64, CAMERA_RECORD)]
    kernels.append(median_depth_kernel(dtype, 1))
    for hits, normals in ((False, False), (True, True)):
        along = RayVariant(3, hits, normals, dtype)
        kernels += [ray_blend_kernel(along), ray_blend_adjoint_kernel(along)]
    for variant in (ColorVariant(), ColorVariant(ALL), ColorVariant(ALL, True, False), ColorVariant(ALL, False, False)):
        kernels += [color_kernel(dtype, False, variant), color_kernel(dtype, True, variant)]
        kernels.append(color_adjoint_kernel(dtype, variant))
    kernels += camera_position_kernels(dtype)
    kernels += [
        distribute_kernel(channels, thermal_channels, dtype, absgrad, per_pair, first_channels)
        for channels, thermal_channels, per_pair, first_channels in ((3, 0, 0, 3), (11, 8, 0, 3), (11, 8, 8, 3))
        for absgrad in (False, True)
    ]
    return kernels


@pytest.mark.parametrize("arch", [75, 90])
def test_rendering_compiles_for_cuda(arch: int, tmp_path: Path) -> None:
    """Binning, the forward kernel and the atomic adjoint of RGB, with warp intrinsics and the butterfly reduction."""
    layout = BlendLayout(16, 8, 8, 32)
    variant = blend_variant(3, 0, wp.float32, layout)
    kernels = [*binning_kernels(wp.float32, 32), blend_kernel(variant), blend_adjoint_kernel(variant, False, False)]
    compile_all(kernels, arch, tmp_path)


@pytest.mark.slow
def test_gaussian_kernels_compile_for_cuda(tmp_path: Path) -> None:
    """Activations, projection, colours, binning, sums."""
    compile_all(gaussian_kernels(wp.float32), 90, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "arch"), ENDS)
def test_a_kernel_of_each_kind_compiles(dtype: type, arch: int, tmp_path: Path) -> None:
    """What does the most of its kind: gradients to cameras, a rolling shutter, two opacities, rays."""
    kernels = [*binning_kernels(dtype, 32), projection_kernel(dtype, "pinhole", False)]
    kernels += [projection_adjoint_kernel(dtype, "pinhole", False, True, True), camera_finish_kernel(dtype)]
    kernels += [color_kernel(dtype, True, ColorVariant(ALL)), color_adjoint_kernel(dtype, ColorVariant(ALL))]
    kernels += [distribute_kernel(11, 8, dtype, True, 8, 3), median_depth_kernel(dtype, 1), *activation_kernels(dtype)]
    for model in ("pinhole", "fisheye"):  # a fraction and an angle
        kernels += [affine_camera_kernel(dtype, model, True), affine_camera_adjoint_kernel(dtype, model, True, True)]
    along = RayVariant(3, True, True, dtype)
    kernels += [ray_blend_kernel(along), ray_blend_adjoint_kernel(along), finish_moments_kernel(dtype)]
    kernels += [strand_sum_kernel(dtype, 3), *camera_position_kernels(dtype)]
    compile_all(kernels, arch, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("arch", [arch for arch in ARCHITECTURES if arch != 90])
def test_the_largest_kernels_compile_for_every_architecture(arch: int, tmp_path: Path) -> None:
    """What needs the most registers and shared memory: blending of two opacities, and the largest decoder."""
    layout = max(cuda_layouts(16, 11, 8, wp.float32), key=lambda one: one.segment)
    variant, along = blend_variant(11, 8, wp.float32, layout, 3), RayVariant(3, True, True, wp.float32)
    kernels = [blend_kernel(variant), blend_adjoint_kernel(variant, False, False), ray_blend_adjoint_kernel(along)]
    if layout.segment > 0:
        kernels += [segment_light_kernel(variant), join_segments_kernel(variant)]
    if arch >= 80:
        largest = max(HIDDEN), True, max(INPUTS)
        kernels += [decode_kernel(*largest), decode_adjoint_kernel(*largest, max(TEAMS))]
    compile_all(kernels, arch, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("model", get_args(LensModel))
def test_lenses_compile_for_cuda(model: LensModel, tmp_path: Path) -> None:
    """All lens models, with and without a rolling shutter, with and without gradients to cameras."""
    kernels = [lens_limit_kernel(wp.float32, model), *motion_kernels(wp.float32)]
    kernels += [strand_sum_kernel(wp.float64, length) for length in (STILL_RECORD, ROLLING_RECORD)]
    for rolling in (False, True):
        kernels += [affine_camera_kernel(wp.float32, model, rolling), lens_finish_kernel(wp.float32, rolling)]
        kernels += [affine_camera_adjoint_kernel(wp.float32, model, rolling, posed) for posed in (False, True)]
    compile_all(kernels, 90, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", HIDDEN)
def test_decoders_compile_for_cuda(hidden: int, tmp_path: Path) -> None:
    """All sizes, with and without a modulation, with a warp or two for 16 pixels."""
    shapes = [(hidden, modulated, inputs) for modulated in (False, True) for inputs in INPUTS]
    kernels = [decode_kernel(*shape) for shape in shapes]
    kernels += [decode_adjoint_kernel(*shape, team) for shape in shapes for team in TEAMS]
    compile_all(kernels, 90, tmp_path)


def cuda_layouts(tile_size: int, channels: int, thermal_channels: int, dtype: type) -> set[BlendLayout]:
    """All that a CUDA device may be given: few tiles or many, sparse ones or crowded."""
    cuda = SimpleNamespace(is_cuda=True)
    return {
        default_layout(cuda, tile_size, channels, thermal_channels, dtype, pairs_a_tile * tiles, tiles)
        for pairs_a_tile in (1, 1000)
        for tiles in (100, 100_000)
    }


CHANNELS = [(1, 0), (3, 0), (11, 0), (11, 8), (32, 0)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tile_size", "channels", "thermal_channels", "dtype"),
    [
        *((tile_size, *channels, wp.float32) for tile_size in (8, 16, 32) for channels in CHANNELS),
        (16, 11, 8, wp.float64),
    ],
)
def test_blending_compiles_for_cuda_in_all_layouts(
    tile_size: int, channels: int, thermal_channels: int, dtype: type, tmp_path: Path
) -> None:
    """Tile sizes, channel counts and block shapes, with and without absgrad; float64 is the accuracy reference."""
    layouts = cuda_layouts(tile_size, channels, thermal_channels, dtype)
    for number, layout in enumerate(sorted(layouts, key=str)):
        absgrad = by_slot = number == 0
        first = channels - thermal_channels  # of a frame with two opacities, colours lie apart from the features
        variant = blend_variant(channels, thermal_channels, dtype, layout, first)
        kernels = [blend_kernel(variant), blend_adjoint_kernel(variant, absgrad, by_slot)]
        if layout.segment > 0:
            kernels += [segment_light_kernel(variant), join_segments_kernel(variant)]
        compile_all(kernels, 90, tmp_path / str(number))
