"""The decoders' kernels without a GPU: their bodies run in Python, a thread a warp, on bytes for shared memory.

Functions on a warp's matrix are NumPy ones here, so how lanes hold a matrix is left out. What the bodies say is in:
addresses, the deal of channels and weights to warps, and every wait, for the threads pause at random, and what has not
been written reads as something else.
"""

import random
import threading
import time
from collections.abc import Callable
from types import CellType, FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from warp_kernels.decoder_memory import NARROW, WARPS, Layout
from warp_kernels.matrix_fragments import PADDING, PIXELS, row_bytes

Array = NDArray[np.float32]
Functions = dict[str, Callable[..., Any]]

TIMEOUT_S = 60.0
"""A warp that waits longer waits for nobody."""


class Rows:
    """An array as a kernel sees it."""

    def __init__(self, numbers: Array) -> None:
        self.numbers = numbers
        self.shape = numbers.shape

    def __getitem__(self, index: int) -> Any:
        found = self.numbers[index]
        return Rows(found) if isinstance(found, np.ndarray) else found


class Block:
    """A block's shared memory and barriers, and the functions of a kernel on them.

    Args:
        hidden: Channels of hidden layers.
        modulated: Whether there is a modulation.
        team: Warps that share 16 pixels.
        layout: Of shared memory.
        size: Of shared memory [bytes].
    """

    def __init__(self, hidden: int, modulated: bool, team: int, layout: Layout, size: int) -> None:
        self.hidden, self.modulated, self.layout = hidden, modulated, layout
        self.own, self.teams = hidden // team, WARPS // team
        self.memory = np.full(size, 0xCD, np.uint8)
        self.all = threading.Barrier(WARPS)
        self.of_team = [threading.Barrier(team) for _ in range(self.teams)]

    def read(self, at: int, rows: int, columns: int, pitch: int) -> Array:
        """A matrix of float16, its rows ``pitch`` bytes apart."""
        pause()
        starts = [at + row * pitch for row in range(rows)]
        return np.stack([self.memory[start : start + 2 * columns].view(np.float16) for start in starts]).astype(
            np.float32
        )

    def write(self, at: int, numbers: Array, pitch: int) -> None:
        """Writes a matrix."""
        pause()
        for row, values in enumerate(numbers.astype(np.float16)):
            self.memory[at + row * pitch : at + row * pitch + 2 * len(values)] = values.view(np.uint8)

    def load_parameters(self, base: int, *arguments: Any) -> None:
        """Weights and biases, padded with zeros, by the first warp."""
        *parameters, thread = arguments
        at, hidden = self.layout, self.hidden
        places = [(at.w1, hidden, NARROW, at.b1), (at.w2, hidden, hidden, at.b2), (at.w3, hidden, hidden, at.b3)]
        places += [(at.modulation, 2 * hidden, hidden, at.b_modulation), (at.head, NARROW, hidden, at.b_head)]
        for k, (start, rows, columns, bias_start) in enumerate(places):
            if thread == 0 and (k != 3 or self.modulated):
                weight, bias = np.zeros((rows, columns), np.float32), np.zeros(rows, np.float32)
                given, given_bias = parameters[2 * k].numbers, parameters[2 * k + 1].numbers
                weight[: given.shape[0], : given.shape[1]] = given
                bias[: len(given_bias)] = given_bias
                self.write(base + start, weight, 2 * columns + PADDING)
                self.memory[base + bias_start : base + bias_start + 4 * rows] = bias.view(np.uint8)
        self.all.wait(TIMEOUT_S)

    def linear(self, columns: int, outputs: int) -> Callable[..., Array]:
        """x Wᵀ + b, and sums to add to where they are given."""

        def product(x: Array, weights: int, bias: int, *added_and_lane: Any) -> Array:
            assert x.shape == (PIXELS, columns)
            b = self.memory[bias : bias + 4 * outputs].view(np.float32).copy()
            return sum(added_and_lane[:-1], x @ self.read(weights, outputs, columns, row_bytes(columns)).T + b)

        return product

    def linear_adjoint(self, columns: int, outputs: int, among: int) -> Callable[..., Array]:
        """v W and sums to add to."""

        def product(v: Array, weights: int, added: Array, lane: int) -> Array:
            assert v.shape == (PIXELS, outputs)
            return v @ self.read(weights, outputs, columns, row_bytes(among)) + added

        return product

    def add_outer(self, rows: int, columns: int, outputs: int, inputs: int) -> Callable[..., Array]:
        """A part of vᵀ x over all pixels of the block."""

        def added(v: int, x: int, row: int, column: int, sums: Array, lane: int) -> Array:
            of_v = self.read(v + 2 * row, self.teams * PIXELS, rows, row_bytes(outputs))
            return sums + of_v.T @ self.read(x + 2 * column, self.teams * PIXELS, columns, row_bytes(inputs))

        return added

    def add_columns(self, outputs: int) -> Callable[..., Array]:
        """Sums of 16 columns of v over all pixels of the block, in one column of sums."""

        def added(v: int, column: int, place: int, sums: Array, lane: int) -> Array:
            total = sums.copy()
            total[:, place] += self.read(v + 2 * column, self.teams * PIXELS, 16, row_bytes(outputs)).sum(0)
            return total

        return added

    def functions(self) -> Functions:
        """Those that kernels have in their closures, by name."""
        hidden, own, wide, narrow = self.hidden, self.own, row_bytes(self.hidden), row_bytes(NARROW)
        part = (hidden // 2, hidden // 4)
        return {
            "address": lambda tile: 0,
            "load_parameters": self.load_parameters,
            "first_layer": self.linear(NARROW, own),
            "layer": self.linear(hidden, own),
            "layer_added": self.linear(hidden, own),
            "head": self.linear(hidden, NARROW),
            "to_features": self.linear_adjoint(NARROW, hidden, NARROW),
            "back": self.linear_adjoint(own, hidden, hidden),
            "from_head": self.linear_adjoint(own, NARROW, hidden),
            "square": self.add_outer(*part, hidden, hidden),
            "beside_features": self.add_outer(16, 8, hidden, NARROW),
            "beside_image": self.add_outer(16, 8, NARROW, hidden),
            "bias_sums": self.add_columns(hidden),
            "bias_sums16": self.add_columns(NARROW),
            "put": lambda numbers, at, lane: self.write(at, numbers, wide),
            "put_narrow": lambda numbers, at, lane: self.write(at, numbers, narrow),
            "get_own": lambda at, lane: self.read(at, PIXELS, own, wide),
            "get_narrow": lambda at, lane: self.read(at, PIXELS, NARROW, narrow),
            "whole": lambda p, at, lane: p if own == hidden else self.read(at, PIXELS, hidden, wide),
            "wait_for_team": lambda team: self.of_team[team].wait(TIMEOUT_S),
            "rounded": rounded,
            "rounded16": rounded,
            "widened": lambda numbers: numbers,
            "silu": lambda z: rounded(z * sigmoid(z)),
            "silu_slope": lambda z: rounded(sigmoid(z) * (1 + z * (1 - sigmoid(z)))),
            "sums": lambda: np.zeros((PIXELS, own), np.float32),
            "sums16": lambda: np.zeros((PIXELS, NARROW), np.float32),
            "part": lambda: np.zeros(part, np.float32),
            "store_square": store,
            "store_tile": store,
        }

    def run(self, kernel: wp.Kernel, program: int, arguments: list[Any]) -> None:
        """Runs a kernel's body as one program of it, all warps at once."""
        functions, warp = self.functions(), threading.local()
        code, closure = kernel.func.__code__, kernel.func.__closure__
        cells = []
        for name, cell in zip(code.co_freevars, closure, strict=True):
            value = functions.get(name, cell.cell_contents)
            assert not isinstance(value, wp.Function), f"{name} is not emulated"
            cells.append(CellType(value))
        known = kernel.func.__globals__ | {
            "wp": SimpleNamespace(static=lambda x: x, cw_mul=np.multiply, tile_empty=lambda **_: None, int32=None),
            "Address": int,
            "FOUR": lambda: np.zeros((16, 8), np.float32),
            "sync": lambda: self.all.wait(TIMEOUT_S),
            "thread_of_block": lambda: warp.first_thread,
            "program_of_grid": lambda: program,
            "factor_of": lambda largest: 2.0 ** -np.ceil(np.log2(largest)),
            "unscaled_of": lambda largest: 2.0 ** np.ceil(np.log2(largest)),
            "read_features": read_features,
            "read_gradient": read_gradient,
            "write_features": write_pixels,
            "write_image": lambda z, image, pixel, lane: write_pixels(sigmoid(z), image, 1.0, pixel, lane),
            "store_sums": store_sums,
        }
        body, failures = FunctionType(code, known, closure=tuple(cells)), []

        def run_warp(number: int) -> None:
            warp.first_thread = 32 * number
            try:
                body(*arguments)
            except Exception as error:  # raised again by the thread that waits for this one
                failures.append(error)
                for barrier in (self.all, *self.of_team):
                    barrier.abort()

        threads = [threading.Thread(target=run_warp, args=(number,)) for number in range(WARPS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if failures:
            raise failures[0]


def pause() -> None:
    """Now and then lets other warps go first."""
    if random.random() < 0.3:
        time.sleep(2e-3 * random.random())


def rounded(numbers: Array) -> Array:
    """To float16."""
    return numbers.astype(np.float16).astype(np.float32)


def sigmoid(z: Array) -> Array:
    """1 / (1 + exp(-z)); what reads as garbage may overflow."""
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-z))


def read_features(features: Rows, pixel: int, lane: int) -> Array:
    """16 pixels, a 1 behind their channels."""
    matrix, found = np.zeros((PIXELS, NARROW), np.float32), features.numbers[pixel : pixel + PIXELS]
    matrix[: found.shape[0], : found.shape[1]] = found
    matrix[:, found.shape[1]] = 1
    return rounded(matrix)


def read_gradient(image: Rows, v_image: Rows, factor: float, pixel: int, lane: int) -> Array:
    """Scaled gradient before the sigmoid."""
    matrix, y = np.zeros((PIXELS, NARROW), np.float32), image.numbers[pixel : pixel + PIXELS]
    matrix[: y.shape[0], : y.shape[1]] = v_image.numbers[pixel : pixel + PIXELS] * y * (1 - y) * factor
    return matrix


def write_pixels(numbers: Array, target: Rows, scale: float, pixel: int, lane: int) -> None:
    """What of 16 pixels and their channels is no padding."""
    of_image = target.numbers[pixel : pixel + PIXELS]
    of_image[:] = numbers[: of_image.shape[0], : of_image.shape[1]] * scale


def store(
    sums: Array, out: Rows, first: int, rows: int, columns: int, row: int, column: int, biased: bool,
    scale: float, lane: int,
) -> None:  # fmt: skip
    """A part of a weight's gradient, and of its bias's, which is the column behind it."""
    for (r, c), value in np.ndenumerate(sums):
        if row + r < rows and column + c < columns:
            out.numbers[first + (row + r) * columns + column + c] = value * scale
        if row + r < rows and column + c == columns and biased:
            out.numbers[first + rows * columns + row + r] = value * scale


def store_sums(sums: Array, place: int, out: Rows, first: int, rows: int, row: int, scale: float, lane: int) -> None:
    """A bias's gradient."""
    count = min(16, rows - row)
    out.numbers[first + row : first + row + count] = sums[:count, place] * scale
