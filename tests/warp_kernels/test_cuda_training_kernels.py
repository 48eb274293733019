"""The kernels of a training step beside the renderer's compile for CUDA, on machines without a GPU too."""

from pathlib import Path

import pytest
import warp as wp

from compilation_for_cuda import ARCHITECTURES, ENDS, compile_all
from warp_kernels.binning.pair_notes import note_pairs_kernel
from warp_kernels.image_loss.image_loss import image_loss_kernels
from warp_kernels.image_loss.image_loss_adjoint import image_loss_adjoint_kernel
from warp_kernels.projection.row_copies import gather_rows_kernel, place_rows_kernel
from warp_kernels.training.adam import adam_coefficients_kernel, adam_update_kernel
from warp_kernels.training.covered_images import covering_kernels
from warp_kernels.training.density_notes import density_kernel
from warp_kernels.training.depth_spread import moment_kernels, spread_kernels
from warp_kernels.training.finite_check import note_bad_kernel
from warp_kernels.training.gaussian_penalties import penalty_kernels
from warp_kernels.training.point_spread import point_spread_kernels
from warp_kernels.training.position_noise import noise_kernel
from warp_kernels.training.row_adam import row_adam_kernel
from warp_kernels.training.row_fetch import row_fetch_kernel
from warp_kernels.training.small_products import small_product_kernels

pytestmark = pytest.mark.rotating


@pytest.mark.parametrize("arch", ARCHITECTURES)
def test_parameter_kernels_compile_for_cuda(arch: int, tmp_path: Path) -> None:
    """Adam, the finite check, what is noted of pairs, small products, rows copied by their numbers, and the adjoint of
    the image loss, which does the most of what there is beside them."""
    adam = [adam_coefficients_kernel, adam_update_kernel, row_adam_kernel, row_fetch_kernel]
    others = [note_bad_kernel, note_pairs_kernel, *small_product_kernels(wp.float32)]
    others.append(image_loss_adjoint_kernel(wp.float32, 1.5))
    compile_all([*adam, *others, gather_rows_kernel(wp.float32), place_rows_kernel], arch, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "arch"), [*ENDS, (wp.float32, 90)])
def test_image_kernels_compile_for_cuda(dtype: type, arch: int, tmp_path: Path) -> None:
    """Losses, covered and blurred images, and what density control notes."""
    kernels = [*image_loss_kernels(dtype, 1.5, 1e-4, 9e-4, 1e-12), image_loss_adjoint_kernel(dtype, 1.5)]
    images = [*covering_kernels(dtype), *point_spread_kernels(dtype)]
    compile_all([*kernels, *images, density_kernel(dtype)], arch, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "arch"), [*ENDS, (wp.float32, 90)])
def test_gaussian_kernels_compile_for_cuda(dtype: type, arch: int, tmp_path: Path) -> None:
    """Penalties on Gaussians and on the spread of their depths, and the noise on their means."""
    kernels = [*penalty_kernels(dtype), *moment_kernels(dtype, 8), *spread_kernels(dtype, 8), noise_kernel(dtype)]
    compile_all(kernels, arch, tmp_path)
