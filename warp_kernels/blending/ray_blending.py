"""Blending along rays: a Gaussian's response in three dimensions instead of in the image (3DGUT, arXiv 2412.12507).

Per pixel with the ray o + t d: a Gaussian's whitening matrix W = S⁻¹ Rᵀ takes both to where it is a unit sphere, g = W
(o - μ) and h = W d. The ray is nearest at t = -g·h / h·h, at z = g + t h, where σ = ½ |z|² and α = min(ALPHA_MAX, o
exp(-σ)). What is nearest behind the ray's origin is not drawn. Blending is that of ``blending``. Beside features, two
things may be blended that no array holds: t |d|, the distance at which the ray hits the Gaussian, and its third axis,
turned towards the ray's origin.

One thread has a pixel and walks its tile's list; the adjoint adds to Gaussians atomically. On the CPU it is launched on
one thread.
"""

from typing import Any, NamedTuple

import warp as wp

from warp_kernels.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from warp_kernels.machinery.loading import made_once


class RayVariant(NamedTuple):
    """What is blended along rays.

    Attributes:
        channels: of the features, at least 1.
        hits: distances are blended, too.
        normals: third axes are blended, too.
        dtype: ``wp.float32`` or ``wp.float64``.
    """

    channels: int
    hits: bool
    normals: bool
    dtype: type

    def name(self, kernel: str) -> str:
        """Name of one of the kernels."""
        return f"{kernel}_{self.channels}{'_hits' * self.hits}{'_normals' * self.normals}_{self.dtype.__name__}"


class RayTypes(NamedTuple):
    """Warp's types for a variant's numbers.

    Attributes:
        vec3: a place or direction.
        mat33: a whitening matrix.
        vecC: the features.
    """

    vec3: Any
    mat33: Any
    vecC: Any


def ray_types(variant: RayVariant) -> RayTypes:
    """The types of a variant."""
    vector, dtype = wp.types.vector, variant.dtype
    return RayTypes(vector(3, dtype), wp.types.matrix((3, 3), dtype), vector(variant.channels, dtype))


@made_once
def ray_functions(dtype: type):
    """What both passes compute of a ray and a Gaussian.

    Returns:
        ``(pixel, response)``: pixel(index, tiles_x, tiles_y, tile_size, width, height) -> (image, tile); response(W,
        offset, d, opacity) -> (g, h, t, exp(-σ), α), α being 0 where the Gaussian is not drawn.
    """
    vec3, mat33 = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)
    zero, half = dtype(0.0), dtype(0.5)
    alpha_min, alpha_max = dtype(ALPHA_MIN), dtype(ALPHA_MAX)

    @wp.func
    def pixel(index: int, tiles_x: int, tiles_y: int, tile_size: int, width: int, height: int):
        image = index // (width * height)
        in_image = index % (width * height)
        row = (in_image // width) // tile_size
        column = (in_image % width) // tile_size
        return image, (image * tiles_y + row) * tiles_x + column

    @wp.func
    def response(W: mat33, offset: vec3, d: vec3, opacity: dtype):
        g = W * offset
        h = W * d
        t = -wp.dot(g, h) / wp.dot(h, h)
        z = g + t * h
        seen = wp.exp(-half * wp.dot(z, z))
        alpha = wp.min(alpha_max, opacity * seen)
        if not (alpha >= alpha_min and t >= zero):  # so that what is not a number is not drawn
            alpha = zero
        return g, h, t, seen, alpha

    return pixel, response


@made_once
def ray_blend_kernel(variant: RayVariant) -> wp.Kernel:
    """The forward kernel, one thread per pixel."""
    dtype, channels = variant.dtype, variant.channels
    vec3, mat33, vecC = ray_types(variant)
    pixel, response = ray_functions(dtype)
    hits, normals = variant.hits, variant.normals
    zero, one, least = dtype(0.0), dtype(1.0), dtype(TRANSMITTANCE_MIN)

    @wp.kernel(name=variant.name("ray_blend"), enable_backward=False, module="unique")
    def ray_blend(
        first: int,
        tiles_x: int,
        tiles_y: int,
        tile_size: int,
        width: int,
        height: int,
        num_gaussians: int,
        num_cameras: int,
        origins: wp.array(dtype=wp.vec3d),  # [images · height · width]
        directions: wp.array(dtype=vec3),  # [images · height · width]
        means: wp.array(dtype=vec3),  # [scenes · N]
        whitenings: wp.array(dtype=mat33),  # [scenes · N]
        axes: wp.array(dtype=vec3),  # [scenes · N]; [0] without normals
        opacities: wp.array(dtype=dtype),  # [images · N]
        features: wp.array(dtype=vecC),  # [images · N]
        gaussian_ids: wp.array(dtype=wp.int32),  # [pairs]
        tile_offsets: wp.array(dtype=wp.int32),  # [tiles + 1]
        # outputs
        render: wp.array(dtype=vecC),  # [images · height · width]
        hit_sums: wp.array(dtype=dtype),  # [images · height · width]; [0] without hits
        normal_sums: wp.array(dtype=vec3),  # [images · height · width]; [0] without normals
        transmittance: wp.array(dtype=dtype),  # [images · height · width]
        last_pairs: wp.array(dtype=wp.int32),  # [images · height · width]
    ):
        index = wp.tid() + first
        image, tile = pixel(index, tiles_x, tiles_y, tile_size, width, height)
        o = origins[index]
        d = directions[index]
        T = dtype(1.0)
        last = int(-1)
        acc = vecC()
        hit = dtype(0.0)
        normal = vec3()
        for pair in range(tile_offsets[tile], tile_offsets[tile + 1]):
            flat = gaussian_ids[pair]
            gaussian = (image // num_cameras) * num_gaussians + flat % num_gaussians
            mean = means[gaussian]
            offset = vec3(
                dtype(o[0] - wp.float64(mean[0])), dtype(o[1] - wp.float64(mean[1])), dtype(o[2] - wp.float64(mean[2]))
            )
            _g, _h, t, _seen, alpha = response(whitenings[gaussian], offset, d, opacities[flat])
            if alpha > zero:
                behind = T * (one - alpha)
                if behind <= least:
                    break
                w = alpha * T
                f = features[flat]
                for c in range(channels):
                    acc[c] += w * f[c]
                if wp.static(hits):
                    hit += w * t * wp.length(d)
                if wp.static(normals):
                    axis = axes[gaussian]
                    normal += wp.where(wp.dot(axis, d) > zero, -w, w) * axis
                T = behind
                last = pair
        render[index] = acc
        if wp.static(hits):
            hit_sums[index] = hit
        if wp.static(normals):
            normal_sums[index] = normal
        transmittance[index] = T
        last_pairs[index] = last

    return ray_blend


@made_once
def ray_blend_adjoint_kernel(variant: RayVariant) -> wp.Kernel:
    """The adjoint kernel, one thread per pixel, from the last pair that was drawn to the first.

    Returns:
        The Warp kernel. It adds to the Gaussians' gradients and stores those of rays.
    """
    dtype, channels = variant.dtype, variant.channels
    vec3, mat33, vecC = ray_types(variant)
    pixel, response = ray_functions(dtype)
    hits, normals = variant.hits, variant.normals
    zero, one, two, largest = dtype(0.0), dtype(1.0), dtype(2.0), dtype(ALPHA_MAX)

    @wp.kernel(name=variant.name("ray_blend_adjoint"), enable_backward=False, module="unique")
    def ray_blend_adjoint(
        tiles_x: int,
        tiles_y: int,
        tile_size: int,
        width: int,
        height: int,
        num_gaussians: int,
        num_cameras: int,
        origins: wp.array(dtype=wp.vec3d),  # [images · height · width]
        directions: wp.array(dtype=vec3),  # [images · height · width]
        means: wp.array(dtype=vec3),  # [scenes · N]
        whitenings: wp.array(dtype=mat33),  # [scenes · N]
        axes: wp.array(dtype=vec3),  # [scenes · N]; [0] without normals
        opacities: wp.array(dtype=dtype),  # [images · N]
        features: wp.array(dtype=vecC),  # [images · N]
        gaussian_ids: wp.array(dtype=wp.int32),  # [pairs]
        tile_offsets: wp.array(dtype=wp.int32),  # [tiles + 1]
        transmittance: wp.array(dtype=dtype),  # [images · height · width]
        last_pairs: wp.array(dtype=wp.int32),  # [images · height · width]
        v_render: wp.array(dtype=vecC),  # [images · height · width]
        v_hit_sums: wp.array(dtype=dtype),  # [images · height · width]; [0] without hits
        v_normal_sums: wp.array(dtype=vec3),  # [images · height · width]; [0] without normals
        v_transmittance: wp.array(dtype=dtype),  # [images · height · width]
        # outputs
        v_origins: wp.array(dtype=vec3),  # [images · height · width]
        v_directions: wp.array(dtype=vec3),  # [images · height · width]
        v_means: wp.array(dtype=vec3),  # [scenes · N]
        v_whitenings: wp.array(dtype=mat33),  # [scenes · N]
        v_axes: wp.array(dtype=vec3),  # [scenes · N]; [0] without normals
        v_opacities: wp.array(dtype=dtype),  # [images · N]
        v_features: wp.array(dtype=vecC),  # [images · N]
    ):
        index = wp.tid()
        image, tile = pixel(index, tiles_x, tiles_y, tile_size, width, height)
        o = origins[index]
        d = directions[index]
        length = wp.length(d)
        T = transmittance[index]
        v_color = v_render[index]
        behind = v_transmittance[index] * T  # the loss's part of what comes after a pair
        v_o = vec3()
        v_d = vec3()
        v_hit = dtype(0.0)
        v_normal = vec3()
        if wp.static(hits):
            v_hit = v_hit_sums[index]
        if wp.static(normals):
            v_normal = v_normal_sums[index]
        start = tile_offsets[tile]
        for back in range(last_pairs[index] + 1 - start):
            pair = last_pairs[index] - back
            flat = gaussian_ids[pair]
            gaussian = (image // num_cameras) * num_gaussians + flat % num_gaussians
            mean = means[gaussian]
            offset = vec3(
                dtype(o[0] - wp.float64(mean[0])), dtype(o[1] - wp.float64(mean[1])), dtype(o[2] - wp.float64(mean[2]))
            )
            W = whitenings[gaussian]
            g, h, t, seen, alpha = response(W, offset, d, opacities[flat])
            if alpha > zero:
                T = T / (one - alpha)
                w = alpha * T
                f = features[flat]
                value = dtype(0.0)
                v_f = vecC()
                for c in range(channels):
                    value += v_color[c] * f[c]
                    v_f[c] = w * v_color[c]
                if wp.static(hits):
                    value += v_hit * t * length
                if wp.static(normals):
                    axis = axes[gaussian]
                    sign = wp.where(wp.dot(axis, d) > zero, -one, one)
                    value += sign * wp.dot(v_normal, axis)
                    wp.atomic_add(v_axes, gaussian, (sign * w) * v_normal)
                wp.atomic_add(v_features, flat, v_f)
                v_alpha = T * value - behind / (one - alpha)
                behind += w * value
                v_g = vec3()
                v_h = vec3()
                if opacities[flat] * seen <= largest:
                    wp.atomic_add(v_opacities, flat, v_alpha * seen)
                    # z is perpendicular to h, so that t, which moves along h, does not change its length
                    v_g = (-v_alpha * alpha) * (g + t * h)
                    v_h = t * v_g
                if wp.static(hits):
                    v_t = w * v_hit * length / wp.dot(h, h)
                    v_g -= v_t * h
                    v_h -= v_t * (g + two * t * h)
                    v_d += (w * v_hit * t / length) * d
                v_offset = wp.transpose(W) * v_g
                v_o += v_offset
                v_d += wp.transpose(W) * v_h
                wp.atomic_add(v_means, gaussian, -v_offset)
                wp.atomic_add(v_whitenings, gaussian, wp.outer(v_g, offset) + wp.outer(v_h, d))
        v_origins[index] = v_o
        v_directions[index] = v_d

    return ray_blend_adjoint
