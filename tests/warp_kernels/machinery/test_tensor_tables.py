"""Tables of tensors: how launches divide them, and their first and last numbers, up to what 32 bits can number."""

import pytest
import torch
import warp as wp

from warp_kernels.machinery import tensor_tables
from warp_kernels.machinery.tensor_tables import BLOCK, PLACES, QUAD, launches, load_quad, store_quad

LONGEST = 2**31 - 1


@wp.kernel(enable_backward=False, module="unique")
def move_kernel(
    source: wp.uint64,
    first: int,
    size: int,
    # outputs
    target: wp.uint64,
):
    """One thread's numbers from one tensor to another."""
    store_quad(target, first, size, load_quad(source, first, size))


def test_a_launch_has_so_many_tensors() -> None:
    """Each tensor has whole blocks of threads; of more tensors than a table has places the others come next."""
    sizes = [1, QUAD * BLOCK, QUAD * BLOCK + 1, *[7] * PLACES]
    (first, ends), (second, other_ends) = launches(sizes)
    assert (first, second) == (slice(0, PLACES), slice(PLACES, PLACES + 3))
    assert ends[:4] == [BLOCK, 2 * BLOCK, 4 * BLOCK, 5 * BLOCK]
    assert other_ends == [BLOCK, 2 * BLOCK, 3 * BLOCK]
    assert list(launches([])) == []


def test_a_launch_has_no_more_threads_than_have_a_number() -> None:
    """Large tensors are divided over launches although a table has places for all of them."""
    sizes = [LONGEST] * 7 + [5]
    divided = list(launches(sizes))
    assert [some for some, _ in divided] == [slice(0, 3), slice(3, 6), slice(6, 8)]
    for some, ends in divided:
        assert len(ends) == len(sizes[some])
        assert LONGEST / QUAD <= ends[-1] <= tensor_tables.THREADS == 2**31 - 1


@pytest.mark.parametrize("size", [LONGEST, LONGEST - 1, LONGEST - 2, LONGEST - 3])
def test_the_last_numbers_of_the_longest_tensor(device: torch.device, size: int) -> None:
    """Nothing behind the end is read or written, though its index has no 32 bits."""
    first = QUAD * (size // QUAD) if size % QUAD else size - QUAD
    numbers, moved = torch.arange(1.0, 1.0 + QUAD, device=device), torch.full((QUAD,), -1.0, device=device)
    addresses = [(tensor.data_ptr() - 4 * first) % 2**64 for tensor in (numbers, moved)]
    wp.launch(move_kernel, 1, [addresses[0], first, size], [addresses[1]], device=str(device))
    left = size - first
    assert moved.tolist() == [*numbers.tolist()[:left], *[-1.0] * (QUAD - left)]
