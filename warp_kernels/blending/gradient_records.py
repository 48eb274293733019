"""Records of gradients that the blending's adjoint writes, and their sum per Gaussian.

A record holds sums over the pixels of a warp for one Gaussian: p z (2) and p z zᵀ (xx, xy, yy), p being the gradient to
-σ and z the pixel's offset from the Gaussian, in ``alpha.UNIT`` standard deviations; then the gradients to opacity,
[thermal opacity], features (C), [|mean2d| gradients (2), over UNIT²]. What the first five mean for mean2d and root is
worked out once per Gaussian. Sums are added atomically per Gaussian, those to many features, which most of a record
would be, where their gradient lies and not in the record. Where no features are left in it, the other sums are added
where their gradients lie, too, and become them in place. Or records are stored, one per (Gaussian, tile) pair and warp,
and summed per Gaussian afterwards, which is deterministic and lets CPU threads work on disjoint memory.
"""

import warp as wp

from warp_kernels.blending.alpha import UNIT
from warp_kernels.machinery.coalesced_stores import store_functions
from warp_kernels.machinery.loading import made_once

FEW = 4
"""So many features stay in the record: added to in two places, RGB is 3% slower and takes 7% less memory."""

WIDE = 24
"""Channels from which on there may be no records. With 32, a pass both ways takes 28 bytes less for each Gaussian and
5% more time (benchmarks/records/rasterizer-speed.md). With fewer channels, the saving is not worth that."""


def features_apart(channels: int, by_pair: bool) -> bool:
    """Whether features' gradients are summed where they lie, and records have none.

    Args:
        by_pair: records are stored one a pair and warp.
    """
    return not by_pair and channels > FEW


def kept_channels(channels: int, first_channels: int, by_pair: bool) -> tuple[int, int]:
    """Channels whose gradients are in a record.

    Args:
        channels: C, channels blended with the first opacity.
        first_channels: of these, those that lie in an array of their own.
        by_pair: records are stored one a pair and warp.

    Returns:
        Of the first ones all or 0, and of the others.
    """
    first, others = (
        0 if features_apart(count, by_pair) else count for count in (first_channels, channels - first_channels)
    )
    return first, others


def sums_apart(channels: int, first_channels: int, by_pair: bool, absgrad: bool) -> bool:
    """Whether there are no records: all sums are added where gradients lie.

    The other arguments are those of ``kept_channels``.

    Args:
        absgrad: sums of absolute mean2d gradients are wanted; they stay in records.
    """
    many = channels >= WIDE and sum(kept_channels(channels, first_channels, by_pair)) == 0
    return many and not by_pair and not absgrad


def ranges_apart(
    channels: int, first_channels: int, thermal_channels: int, by_pair: bool, absgrad: bool = False
) -> list[tuple[str, int, int]] | None:
    """Components of a Gaussian's sums that are not in its record, for ``accumulate_snippet``.

    The other arguments are those of ``kept_channels``.

    Args:
        thermal_channels: channels blended a second time; 0 for one opacity.

    Returns:
        The half-open ranges by what takes them, "features" or "rest", and without records also "means2d", "roots",
        "opacities" and "thermal_opacities"; None where records have all and are stored.
    """
    if by_pair:
        return None
    apart = []
    if sums_apart(channels, first_channels, by_pair, absgrad):
        apart = [("means2d", 0, 2), ("roots", 2, 5), ("opacities", 5, 6)]
        apart += [("thermal_opacities", 6, 7)] if thermal_channels else []
    kept, kept_rest = kept_channels(channels, first_channels, by_pair)
    first_feature = feature_offset(thermal_channels)
    middle, end = first_feature + first_channels, first_feature + channels
    apart += [("features", first_feature, middle)] if kept < first_channels else []
    return apart + ([("rest", middle, end)] if kept_rest < channels - first_channels else [])


def feature_offset(thermal_channels: int) -> int:
    """Where the features begin in a record.

    Args:
        thermal_channels: channels blended a second time; 0 for one opacity.
    """
    return 7 if thermal_channels else 6


def record_length(channels: int, thermal_channels: int, absgrad: bool) -> int:
    """Numbers in one gradient record.

    Args:
        channels: C, channels blended with the first opacity; 0 where their gradients are elsewhere.
        thermal_channels: channels blended a second time; 0 for one opacity.
        absgrad: sums of absolute mean2d gradients are wanted.
    """
    return feature_offset(thermal_channels) + channels + (2 if absgrad else 0)


@made_once
def _moment_function(dtype: type):
    """What a Gaussian's moments, sums of p z and p z zᵀ over pixels, mean for its mean2d and its root."""
    vec2, vec3 = wp.types.vector(2, dtype), wp.types.vector(3, dtype)
    unit = dtype(UNIT)

    @wp.func
    def from_moments(root: vec3, first: vec2, second: vec3):
        # -σ = -½ |U d|² with U = [u, u k; 0, v], and sums of U d / unit
        u = root[0]
        k = root[1]
        v = root[2]
        v_mean2d = -unit * vec2(u * first[0], u * k * first[0] + v * first[1])
        v_root = -unit * unit * vec3(second[0] / u, second[1] * u / v, second[2] / v)
        return v_mean2d, v_root

    return from_moments


@made_once
def finish_moments_kernel(dtype: type) -> wp.Kernel:
    """Makes gradients of the moments of Gaussians without records, one thread per Gaussian.

    Returns:
        The Warp kernel, launched over ``whole_warps``.
    """
    vec2, vec3 = wp.types.vector(2, dtype), wp.types.vector(3, dtype)
    store2, store3, _ = store_functions(dtype)
    from_moments = _moment_function(dtype)

    @wp.kernel(name=f"finish_moments_{dtype.__name__}", enable_backward=False, module="unique")
    def finish_moments_kernel(
        roots: wp.array(dtype=vec3),  # [images · N]
        first_moments: wp.array(dtype=vec2),  # [images · N]; may be v_means2d
        second_moments: wp.array(dtype=vec3),  # [images · N]; may be v_roots
        store: bool,
        # outputs
        v_means2d: wp.array(dtype=vec2),  # [images · N]
        v_roots: wp.array(dtype=vec3),  # [images · N]
    ):
        g = wp.tid()
        written = int(-1)
        v_mean2d = vec2()
        v_root = vec3()
        if g < roots.shape[0]:
            first = first_moments[g]
            second = second_moments[g]
            # Zeros stay: a Gaussian that is not drawn has them, and its root may be anything.
            if not (first == vec2() and second == vec3()):
                written = g
                v_mean2d, v_root = from_moments(roots[g], first, second)
                if not store:
                    v_mean2d = v_mean2d + v_means2d[g]
                    v_root = v_root + v_roots[g]
        if written >= 0:
            store2(v_means2d, written, v_mean2d)
        store3(v_roots, written, v_root)

    return finish_moments_kernel


@made_once
def distribute_kernel(
    channels: int,
    thermal_channels: int,
    dtype: type,
    absgrad: bool,
    records_per_pair: int,
    first_channels: int | None = None,
) -> wp.Kernel:
    """Sums each Gaussian's records and adds them to the gradients, or stores them there, one thread per Gaussian, or a
    depth rank, as records of pairs lie.

    Args:
        channels: C.
        thermal_channels: D, or 0.
        absgrad: records end with the absolute mean2d gradients.
        records_per_pair: records of a pair, those of a Gaussian's pairs side by side; 0: one record per Gaussian.
        first_channels: of the C, those whose gradients lie in an array of their own; None: all.

    Returns:
        The Warp kernel, launched over ``whole_warps``.
    """
    C, dual, by_pair = channels, thermal_channels > 0, records_per_pair > 0
    A = C if first_channels is None else first_channels
    kept, kept_rest = kept_channels(C, A, by_pair)
    first_feature = feature_offset(thermal_channels)
    first_rest = first_feature + kept
    length = record_length(kept + kept_rest, thermal_channels, absgrad)
    record = wp.types.vector(length, dtype)
    vec2, vec3 = wp.types.vector(2, dtype), wp.types.vector(3, dtype)
    vecA, vecB = wp.types.vector(A, dtype), wp.types.vector(max(C - A, 1), dtype)
    store2, store3, _ = store_functions(dtype)
    from_moments = _moment_function(dtype)
    zero, unit = dtype(0.0), dtype(UNIT)

    @wp.kernel(
        name=f"distribute_{C}_{thermal_channels}_{dtype.__name__}{'_abs' * absgrad}_{records_per_pair}_{A}",
        enable_backward=False,
        module="unique",
    )
    def distribute_records_kernel(
        order: wp.array(dtype=wp.int32),  # [ranks]; [0] where records are those of Gaussians
        pair_ends: wp.array(dtype=wp.int64),  # [ranks]; [0] where records are those of Gaussians
        tiles_per_gaussian: wp.array(dtype=wp.int32),  # [images · N]
        records: wp.array(dtype=record),  # [pairs · records_per_pair], or [images · N] without records of pairs
        roots: wp.array(dtype=vec3),  # [images · N]
        store: bool,
        # outputs
        v_means2d: wp.array(dtype=vec2),  # [images · N]
        v_roots: wp.array(dtype=vec3),  # [images · N]
        v_opacities: wp.array(dtype=dtype),  # [images · N]
        v_thermal_opacities: wp.array(dtype=dtype),  # [images · N]
        v_features: wp.array(dtype=vecA),  # [images · N]
        v_rest: wp.array(dtype=vecB),  # [images · N]; [0]: there are no other channels
        absolute: wp.array(dtype=vec2),  # [images · N]; written with absgrad
    ):
        rank = wp.tid()
        g = int(-1)
        count = int(0)
        if wp.static(by_pair):
            if rank < order.shape[0]:
                g = order[rank]
        elif rank < roots.shape[0]:
            g = rank
        if g >= 0:
            count = tiles_per_gaussian[g]
        v_mean2d = vec2()
        v_root = vec3()
        if count > 0:
            total = record()
            if wp.static(by_pair):
                # a capacity may have cut the last ranges off
                per_pair = wp.int64(records_per_pair)
                end = int(wp.min(pair_ends[rank] * per_pair, wp.int64(records.shape[0])))
                first = int(wp.min((pair_ends[rank] - wp.int64(count)) * per_pair, wp.int64(records.shape[0])))
                for slot in range(first, end):
                    total = total + records[slot]
            else:
                total = records[g]
            v_mean2d, v_root = from_moments(roots[g], vec2(total[0], total[1]), vec3(total[2], total[3], total[4]))
            v_opacity = total[5]
            if not store:
                v_mean2d = v_mean2d + v_means2d[g]
                v_root = v_root + v_roots[g]
                v_opacity = v_opacity + v_opacities[g]
            v_opacities[g] = v_opacity
            if wp.static(dual):
                v_opacity_t = total[6]
                if not store:
                    v_opacity_t = v_opacity_t + v_thermal_opacities[g]
                v_thermal_opacities[g] = v_opacity_t
            if wp.static(kept > 0):
                v_feature = vecA()
                if not store:
                    v_feature = v_features[g]
                for c in range(A):
                    v_feature[c] = v_feature[c] + total[first_feature + c]
                v_features[g] = v_feature
            if wp.static(kept_rest > 0):
                more = vecB()
                if not store:
                    more = v_rest[g]
                for c in range(kept_rest):
                    more[c] = more[c] + total[first_rest + c]
                v_rest[g] = more
            if wp.static(absgrad):
                size = vec2(total[wp.static(length - 2)], total[wp.static(length - 1)])
                absolute[g] = absolute[g] + unit * unit * size
        elif store and g >= 0:
            v_opacities[g] = zero
            if wp.static(dual):
                v_thermal_opacities[g] = zero
            if wp.static(kept > 0):
                v_features[g] = vecA()
            if wp.static(kept_rest > 0):
                v_rest[g] = vecB()
        written = wp.where(count > 0 or store, g, -1)
        if written >= 0:
            store2(v_means2d, written, v_mean2d)
        store3(v_roots, written, v_root)

    return distribute_records_kernel
