"""View-dependent colour from real spherical harmonics (harmonic_basis), and its adjoint.

The colour is max(Σ_k basis_k(d) · coefficient_k + 0.5, 0) for the unit direction d from the camera to the mean. Other
variants leave the limit away, or the limit and the half (``ColorVariant``).
"""

from typing import NamedTuple

import warp as wp

from warp_kernels.color.coefficient_rows import BLOCK, row_adjoint_function, row_sum_function
from warp_kernels.color.harmonic_basis import FEW, basis_functions
from warp_kernels.machinery.coalesced_stores import store_functions
from warp_kernels.machinery.flat_index import image_and_row
from warp_kernels.machinery.lanes import LANES_CUDA, warp_sync
from warp_kernels.machinery.launching import SMALL_BLOCK
from warp_kernels.machinery.loading import made_once
from warp_kernels.machinery.warp_lists import EACH, MANY, WARPS, list_functions


class ColorVariant(NamedTuple):
    """One kind of sums of spherical harmonics, for which kernels are made."""

    most: int = FEW
    """Values of the basis that there is room for: ``harmonic_basis.values_for`` the degree."""
    shifted: bool = True
    """0.5 is added to the sum."""
    clamped: bool = True
    """What is below 0 becomes 0; goes with ``shifted``."""

    def name(self, kernel: str, dtype: type) -> str:
        """Name of one of the kernels."""
        kind = "" if self.clamped else "_shifted" if self.shifted else "_plain"
        return f"{kernel}_{dtype.__name__}{'' if self.most == FEW else f'_{self.most}'}{kind}"


@made_once
def direction_function(dtype: type):
    """Unit direction from the camera to a mean, as a Warp function.

    Returns:
        ``direction(mean, camera_position) -> (unit, 1 / length)``; both zero where the mean is at the camera. The
        difference is taken in float64: far from the origin it cancels.
    """
    vec3 = wp.types.vector(3, dtype)

    @wp.func
    def direction(mean: vec3, camera_position: wp.vec3d):
        offset = vec3(
            dtype(wp.float64(mean[0]) - camera_position[0]),
            dtype(wp.float64(mean[1]) - camera_position[1]),
            dtype(wp.float64(mean[2]) - camera_position[2]),
        )
        length = wp.length(offset)
        unit = vec3()
        inverse = dtype(0.0)
        if length > dtype(0.0):
            inverse = dtype(1.0) / length
            unit = offset * inverse
        return unit, inverse

    return direction


@made_once
def color_kernel(dtype: type, many: bool, variant: ColorVariant) -> wp.Kernel:
    """Forward kernel: colour of each (image, Gaussian) pair, not written where the Gaussian is culled.

    Args:
        many: a warp lists the visible ones of many before it works on them, on CUDA only; else a thread has one.

    Returns:
        The Warp kernel, with ``many`` launched over ``warp_lists.threads_of_many`` in blocks of ``SMALL_BLOCK``.
        ``rows`` begin with the coefficient ``lowest``; where that is 1, ``sh0`` has that of degree 0.
    """
    vec3 = wp.types.vector(3, dtype)
    basis, _ = basis_functions(dtype, variant.most)
    row_sum = row_sum_function(dtype, variant.most)
    shifted, clamped = variant.shifted, variant.clamped
    direction = direction_function(dtype)
    each, lanes = (EACH, LANES_CUDA) if many else (1, 1)
    vec_each = wp.types.vector(each, wp.int32)
    list_of_warp, append, item = list_functions(WARPS, MANY)

    bounds = _launch_bounds(dtype, variant, SMALL_BLOCK if many else BLOCK)

    @wp.kernel(
        name=variant.name("sh_colors", dtype) + "_many" * many,
        enable_backward=False,
        module="unique",
        launch_bounds=bounds,
    )
    def sh_colors_kernel(
        first: int,
        num_gaussians: int,
        num_cameras: int,
        per_image: bool,
        degree: int,
        means: wp.array(dtype=vec3),  # [scenes · N]
        camera_positions: wp.array(dtype=wp.vec3d),  # [images]
        sh0: wp.array2d(dtype=vec3),  # [scenes · N or images · N, 1]
        rows: wp.array2d(dtype=vec3),  # [scenes · N or images · N, K - lowest]
        lowest: int,
        visible: wp.array(dtype=wp.bool),  # [images · N]
        # outputs
        colors: wp.array(dtype=vec3),  # [images · N]
    ):
        thread = wp.tid() + first
        lane = thread % lanes
        nearest = (thread // lanes) * wp.static(each * lanes) + lane
        seen = vec_each()
        for j in range(each):  # all are asked for before the first is looked at
            if nearest + j * lanes < visible.shape[0]:
                seen[j] = wp.where(visible[nearest + j * lanes], 1, 0)
        count = seen[0]
        listed = wp.uint64(0)
        if wp.static(many):
            listed = list_of_warp((thread // lanes) % wp.static(WARPS))
            count = int(0)
            warp_sync()  # of a grid that goes round, all lanes have read the list before
            for j in range(each):
                count = append(listed, count, lane, seen[j] > 0, nearest + j * lanes)
            warp_sync()
        for k in range(lane, count, lanes):
            index = nearest
            if wp.static(many):
                index = item(listed, k)
            image, gaussian = image_and_row(index, num_gaussians, num_cameras)
            row = wp.where(per_image, index, gaussian)
            unit, _ = direction(means[gaussian], camera_positions[image])
            b = basis(unit, degree)
            color = vec3()
            if lowest > 0:
                color = b[0] * sh0[row, 0]
            color = row_sum(rows, lowest, row, b, (degree + 1) * (degree + 1), color)
            # Added last, as 3DGS does: an initial black, -0.5 by then, becomes 0 and not what an FMA leaves of it.
            if wp.static(shifted):
                color = color + vec3(dtype(0.5), dtype(0.5), dtype(0.5))
            if wp.static(clamped):
                for c in range(3):
                    # Not max(): a NaN must stay visible to the binning, which hides such Gaussians.
                    if color[c] < dtype(0.0):
                        color[c] = dtype(0.0) * color[c]  # -0, whose sign tells the adjoint
            colors[index] = color

    return sh_colors_kernel


@made_once
def color_adjoint_kernel(dtype: type, variant: ColorVariant) -> wp.Kernel:
    """Adjoint kernel: one thread per Gaussian of a scene walks its cameras, so that nothing is atomic.

    Returns:
        The Warp kernel. It adds to coefficients and means, or with ``store`` writes them, and where there is room for
        it stores the direction's part per (image, Gaussian), whose negative sum is the gradient to the camera position.
        ``rows`` begin with the coefficient ``lowest``; where that is 1, ``v_sh0`` takes the gradient of degree 0. It
        is launched over ``whole_warps``.
    """
    vec3, vecK = wp.types.vector(3, dtype), wp.types.vector(variant.most, dtype)
    basis, basis_adjoint = basis_functions(dtype, variant.most)
    direction = direction_function(dtype)
    row_adjoint = row_adjoint_function(dtype, variant.most)
    _, store3, _ = store_functions(dtype)
    bounds = _launch_bounds(dtype, variant)
    clamped = variant.clamped

    @wp.kernel(
        name=variant.name("sh_colors_adjoint", dtype), enable_backward=False, module="unique", launch_bounds=bounds
    )
    def sh_colors_adjoint_kernel(
        first: int,
        num_gaussians: int,
        num_cameras: int,
        per_image: bool,
        degree: int,
        means: wp.array(dtype=vec3),  # [scenes · N]
        camera_positions: wp.array(dtype=wp.vec3d),  # [images]
        rows: wp.array2d(dtype=vec3),  # [scenes · N or images · N, K - lowest]
        visible: wp.array(dtype=wp.bool),  # [images · N]
        colors: wp.array(dtype=vec3),  # [images · N]
        v_colors: wp.array(dtype=vec3),  # [images · N]
        lowest: int,
        store: bool,
        # outputs
        v_sh0: wp.array2d(dtype=vec3),  # [scenes · N or images · N, 1]
        v_rows: wp.array2d(dtype=vec3),  # [scenes · N or images · N, K - lowest]
        v_means: wp.array(dtype=vec3),  # [scenes · N]
        v_offsets: wp.array(dtype=vec3),  # [images · N]; [0]: not wanted
    ):
        thread = wp.tid() + first
        inside = thread < means.shape[0]
        gaussian = wp.min(thread, means.shape[0] - 1)
        scene = gaussian // num_gaussians
        total = vec3()
        for camera in range(num_cameras):
            image = scene * num_cameras + camera
            index = image * num_gaussians + gaussian % num_gaussians
            row = wp.where(per_image, index, gaussian)
            used = inside and visible[index]
            unit = vec3()
            inverse = dtype(0.0)
            b = vecK()
            v = vec3()
            if used:
                unit, inverse = direction(means[gaussian], camera_positions[image])
                b = basis(unit, degree)
                v = v_colors[index]
                if wp.static(clamped):
                    color = colors[index]
                    for c in range(3):
                        # A colour that was clamped is -0; one that is 0 by itself, an initial black, must be able to
                        # grow.
                        if dtype(1.0) / color[c] < dtype(0.0):
                            v[c] = dtype(0.0)
            add = not store or (camera > 0 and not per_image)
            active = (degree + 1) * (degree + 1)
            v_basis = row_adjoint(rows, v_rows, lowest, wp.where(inside, row, -1), b, v, active, used, add)
            if inside:
                if lowest > 0:
                    if add:
                        v_sh0[row, 0] = v_sh0[row, 0] + b[0] * v
                    else:
                        v_sh0[row, 0] = b[0] * v
                v_offset = vec3()
                if used:
                    v_unit = basis_adjoint(unit, degree, v_basis)
                    v_offset = (v_unit - wp.dot(v_unit, unit) * unit) * inverse
                    if wp.isfinite(v) and not wp.isfinite(v_offset):
                        v_offset = vec3()  # the camera is too near for its gradient to be held
                if v_offsets.shape[0] > 0:
                    v_offsets[index] = v_offset
                total = total + v_offset
        if inside and not store:
            total = v_means[gaussian] + total
        store3(v_means, wp.where(inside, gaussian, -1), total)

    return sh_colors_adjoint_kernel


def _launch_bounds(dtype: type, variant: ColorVariant, block: int = BLOCK) -> tuple[int, int] | None:
    """A row is 48 registers, and 24 warps a multiprocessor keep enough of them under way; of degree 4 it is 75."""
    if dtype is not wp.float32:
        return None
    return block, (768 if variant.most == FEW else 512) // block
