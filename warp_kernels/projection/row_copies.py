"""Rows gathered by their numbers, and places for the rows that are wanted: Gaussians on their way between ranks."""

import warp as wp

from warp_kernels.machinery.launching import launch
from warp_kernels.machinery.loading import made_once


@made_once
def gather_rows_kernel(dtype: type) -> wp.Kernel:
    """The kernel, one thread for each number that is copied."""

    @wp.kernel(name=f"gather_rows_{dtype.__name__}", enable_backward=False, module="unique")
    def gather_kernel(
        first: int,
        numbers: wp.array(dtype=wp.int32),  # [n]
        table: wp.array2d(dtype=dtype),  # [N, X]
        # outputs
        rows: wp.array2d(dtype=dtype),  # [n, X]
    ):
        thread = wp.tid() + first
        row = thread // rows.shape[1]
        column = thread - row * rows.shape[1]
        number = numbers[row]
        value = dtype(0.0)
        if number >= 0:
            value = table[number, column]
        rows[row, column] = value

    return gather_kernel


def gather_rows(numbers: wp.array, table: wp.array, rows: wp.array) -> None:
    """Copies rows of a table.

    Args:
        numbers: int32 [n], which rows; negative: a row of zeros.
        table: [N, X], of any strides.
        rows: [n, X], written.
    """
    launch(gather_rows_kernel(rows.dtype), rows.shape[0] * rows.shape[1], [numbers, table, rows], rows.device)


@wp.kernel(enable_backward=False, module="unique")
def place_rows_kernel(
    first: int,
    until: wp.array(dtype=wp.int32),  # [C * N]
    num_gaussians: int,
    room: int,
    # outputs
    numbers: wp.array(dtype=wp.int32),  # [C * room]
    places: wp.array(dtype=wp.int32),  # [C * N]
):
    """One thread per row."""
    row = wp.tid() + first
    camera = row // num_gaussians
    before_camera = int(0)
    if camera > 0:
        before_camera = until[camera * num_gaussians - 1]
    before = int(0)
    if row > 0:
        before = until[row - 1]
    place = before - before_camera
    if until[row] == before or place >= room:
        places[row] = -1
    else:
        places[row] = place
        numbers[camera * room + place] = row


def place_rows(until: wp.array, num_gaussians: int, room: int, numbers: wp.array, places: wp.array) -> None:
    """Gives the wanted rows of each camera their places, from the first on, as far as there is room.

    Args:
        until: int32 [C · N], how many rows are wanted up to each one, it included.
        num_gaussians: N.
        room: Places of a camera.
        numbers: int32 [C · room], written where there is a row: its number.
        places: int32 [C · N], written: the place of a row among its camera's, or -1.
    """
    launch(place_rows_kernel, until.shape[0], [until, num_gaussians, room, numbers, places], until.device)
