"""Rows of tables gathered by their numbers, and put back: projected Gaussians on their way between ranks."""

import warp as wp

from warp_kernels.machinery.launching import launch
from warp_kernels.machinery.loading import made_once


@made_once
def row_copy_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """The kernels, one thread for each number that is copied.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``(gather, scatter)``.
    """

    @wp.kernel(name=f"gather_rows_{dtype.__name__}", enable_backward=False, module="unique")
    def gather_kernel(
        first: int,
        numbers: wp.array(dtype=wp.int64),  # [n]
        table: wp.array2d(dtype=dtype),  # [N, X]
        # outputs
        rows: wp.array2d(dtype=dtype),  # [n, X]
    ):
        thread = wp.tid() + first
        row = thread // rows.shape[1]
        column = thread - row * rows.shape[1]
        number = int(numbers[row])
        value = dtype(0.0)
        if number < table.shape[0]:
            value = table[number, column]
        rows[row, column] = value

    @wp.kernel(name=f"scatter_rows_{dtype.__name__}", enable_backward=False, module="unique")
    def scatter_kernel(
        first: int,
        numbers: wp.array(dtype=wp.int64),  # [n]
        rows: wp.array2d(dtype=dtype),  # [n, X]
        # outputs
        table: wp.array2d(dtype=dtype),  # [N, X]
    ):
        thread = wp.tid() + first
        row = thread // rows.shape[1]
        column = thread - row * rows.shape[1]
        number = int(numbers[row])
        if number < table.shape[0]:
            table[number, column] = rows[row, column]

    return gather_kernel, scatter_kernel


def gather_rows(numbers: wp.array, table: wp.array, rows: wp.array) -> None:
    """Copies rows of a table.

    Args:
        numbers: int64 [n], which rows; N or above: a row of zeros.
        table: [N, X].
        rows: [n, X], written.
    """
    gather, _ = row_copy_kernels(rows.dtype)
    launch(gather, rows.shape[0] * rows.shape[1], [numbers, table, rows], rows.device)


def scatter_rows(numbers: wp.array, rows: wp.array, table: wp.array) -> None:
    """Writes rows to their places in a table.

    Args:
        numbers: int64 [n], all different below N; N or above: the row is left out.
        rows: [n, X].
        table: [N, X], written at these rows only.
    """
    _, scatter = row_copy_kernels(rows.dtype)
    launch(scatter, rows.shape[0] * rows.shape[1], [numbers, rows, table], rows.device)
