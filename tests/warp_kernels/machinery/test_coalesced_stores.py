"""Stores that a warp does together: vectors are where plain stores would put them, and nothing else has changed."""

import functools

import numpy as np
import pytest
import torch
import warp as wp

from warp_kernels.machinery.coalesced_stores import store_functions
from warp_kernels.machinery.lanes import whole_warps

ROWS = 77
"""Not a multiple of a warp."""


@functools.cache
def store_kernel(dtype: type) -> wp.Kernel:
    """Stores one vector of each length a thread; the vec3 also where the index is negative, in vain."""
    vec2, vec3, vec4 = (wp.types.vector(k, dtype) for k in (2, 3, 4))
    store2, store3, store4 = store_functions(dtype)

    @wp.kernel(name=f"store_vectors_{dtype.__name__}", module="unique", enable_backward=False)
    def store(
        places: wp.array(dtype=int),
        values: wp.array(dtype=vec4),
        # outputs
        pairs: wp.array(dtype=vec2),
        triples: wp.array(dtype=vec3),
        quads: wp.array(dtype=vec4),
    ):
        thread = wp.tid()
        place = -1
        value = vec4()
        if thread < places.shape[0]:
            place = places[thread]
            value = values[thread]
        store3(triples, place, vec3(value[0], value[1], value[2]))
        if place >= 0:
            store2(pairs, place, vec2(value[0], value[1]))
            store4(quads, place, value)

    return store


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
@pytest.mark.parametrize("order", ["in order", "shuffled", "gaps"])
@pytest.mark.parametrize("first", [0, 1])
def test_vectors_arrive(device: torch.device, dtype: type, order: str, first: int) -> None:
    """In order, shuffled or with lanes that store nothing; arrays that begin at any multiple of a vector."""
    rng = np.random.default_rng(0)
    places = rng.permutation(ROWS) if order == "shuffled" else np.arange(ROWS)
    if order == "gaps":
        places = np.where(rng.random(ROWS) < 0.5, -1, places)
    values = rng.normal(size=(ROWS, 4)).astype(np.float32)
    where = wp.get_device(str(device))
    outputs = [wp.zeros(ROWS + 1, dtype=wp.types.vector(k, dtype), device=where)[first:] for k in (2, 3, 4)]
    inputs = [
        wp.array(places, dtype=int, device=where),
        wp.array(values, dtype=wp.types.vector(4, dtype), device=where),
    ]
    wp.launch(store_kernel(dtype), dim=whole_warps(ROWS, where), inputs=inputs, outputs=outputs, device=where)
    for width, output in zip((2, 3, 4), outputs, strict=True):
        expected = np.zeros((ROWS + 1 - first, width))
        expected[places[places >= 0]] = values[places >= 0, :width]
        np.testing.assert_array_equal(output.numpy(), expected)
