"""The last pair and the light of a pixel, in one number and back."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.binning.binning_step import PAIRS_MAX
from warp_kernels.blending.pixel_ends import end_functions, pair_bits
from warp_kernels.constants import TRANSMITTANCE_MIN


def there_and_back(light: np.ndarray, last: np.ndarray, num_pairs: int, dtype: type) -> tuple[np.ndarray, np.ndarray]:
    """Both, from the packed numbers and the alphas."""
    pack_end, unpack_end = end_functions(dtype)

    @wp.kernel(name=f"ends_{dtype.__name__}", enable_backward=False, module="unique")
    def ends_kernel(
        bits: int,
        light: wp.array(dtype=dtype),  # [pixels]
        last: wp.array(dtype=wp.int32),  # [pixels]
        # outputs
        light_again: wp.array(dtype=dtype),  # [pixels]
        last_again: wp.array(dtype=wp.int32),  # [pixels]
    ):
        i = wp.tid()
        alpha = dtype(1.0) - light[i]
        pair, rest = unpack_end(pack_end(last[i], light[i], alpha, bits), alpha, bits)
        light_again[i] = rest
        last_again[i] = pair

    given = [wp.array(light, dtype=dtype, device="cpu"), wp.array(last, dtype=wp.int32, device="cpu")]
    found = [wp.zeros_like(one) for one in given]
    wp.launch(ends_kernel, dim=len(light), inputs=[pair_bits(num_pairs), *given, *found], device="cpu")
    return found[0].numpy(), found[1].numpy()


@pytest.mark.parametrize(
    ("dtype", "num_pairs", "tolerance"),
    [
        (wp.float32, 0, 0.0),
        (wp.float32, 300, 0.0),
        (wp.float32, 500_000, 0.0),
        (wp.float32, 1_000_000, 2.0**-37),
        (wp.float32, 2**24 - 1, 2.0**-31),
        (wp.float32, PAIRS_MAX, 2.0**-26),
        (wp.float64, 1_000_000, 2.0**-64),
        (wp.float64, PAIRS_MAX, 2.0**-55),
    ],
)
def test_light_and_last_pair_come_back(dtype: type, num_pairs: int, tolerance: float) -> None:
    """To the bit where half a million pairs leave room for it; to a step where there are more. Pairs always do."""
    rng = np.random.default_rng(0)
    kind = np.float32 if dtype is wp.float32 else np.float64
    light = np.exp(rng.uniform(np.log(TRANSMITTANCE_MIN), 0.0, size=4000)).astype(kind)
    light[:4] = 1.0, 0.5, np.nextafter(kind(0.5), kind(0)), np.nextafter(kind(TRANSMITTANCE_MIN), kind(1))
    last = rng.integers(-1, max(num_pairs, 1), size=4000)
    last[:4] = -1, num_pairs - 1, -1, num_pairs - 1
    found, pairs = there_and_back(light, last, num_pairs, dtype)
    assert np.array_equal(pairs, last)
    rounded, little = kind(1) - (kind(1) - light), light < 0.25
    assert np.abs(found - light).max() <= np.abs(rounded - light).max() * (tolerance > 0)
    assert np.abs(found - light)[little].max() <= tolerance < np.abs(rounded - light)[little].max()
