"""What warps that decode hold in shared memory, and how pixels and gradients come from memory and go there.

Bodies on CUDA only, as in matrix_fragments.py, which says how a warp holds a matrix of 16 pixels.
"""

from typing import NamedTuple

import warp as wp

from warp_kernels.decoding.matrix_fragments import PACK, PADDING, PIXELS, SIGMOID, Address, fragments, row_bytes
from warp_kernels.machinery.lanes import on_cuda
from warp_kernels.machinery.loading import made_once

WARPS = 8
"""Warps of a block; the parts of a weight's gradient are dealt to two by four of them."""

THREADS = 32 * WARPS

TEAMS = (1, 2)
"""Warps that may share 16 pixels in the adjoint, half of each layer's channels each: a block's shared memory then holds
half as many pixels. One is quicker where there is room: nobody waits for a partner."""

INPUTS = (16, 32)
"""Columns of features, with a 1 behind them, padded, that there are kernels for."""

NARROW = 16
"""Columns of images, padded."""

MATRIX, ARRAY = wp.array2d(dtype=wp.float32), wp.array(dtype=wp.float32)

FOUR = wp.types.vector(4, wp.float32)
"""Sums a lane of 16 rows and 8 columns."""

_sums = fragments(NARROW).sums


def padded_inputs(channels: int) -> int | None:
    """The fewest of INPUTS that have room for features and the 1 behind them; None: there are no kernels."""
    return next((inputs for inputs in INPUTS if channels < inputs), None)


class Layout(NamedTuple):
    """Where things lie in a block's shared memory [bytes]."""

    w1: int
    w2: int
    w3: int
    modulation: int
    head: int
    b1: int
    b2: int
    b3: int
    b_modulation: int
    b_head: int
    features: int
    first: int
    encoded: int
    prior: int
    v_image: int
    factors: tuple[int, int]
    """Two matrices of factors that take turns."""
    forward_size: int
    size: int


@made_once
def layout_of(hidden: int, modulated: bool, inputs: int, team: int = 1) -> Layout:
    """Shared memory of a block.

    Args:
        modulated: whether there is a modulation.
        inputs: columns of features, of INPUTS.
        team: warps that share 16 pixels, of TEAMS. What the forward pass uses is the same for all.
    """
    wide, narrow, of_features = row_bytes(hidden), row_bytes(NARROW), row_bytes(inputs)
    pixels = WARPS // team * PIXELS
    twice = 2 * hidden if modulated else 0
    sizes = [hidden * of_features, hidden * wide, hidden * wide, twice * wide, NARROW * wide]
    sizes += [4 * hidden, 4 * hidden, 4 * hidden, 4 * twice, 4 * NARROW]
    sizes += [pixels * of_features, *[pixels * wide] * 3, pixels * narrow, pixels * wide, pixels * wide]
    starts = [0]
    for size in sizes:
        starts.append(starts[-1] + size)
    return Layout(*starts[:15], (starts[15], starts[16]), starts[10], starts[17])


@made_once
def shared_address(size: int) -> tuple[int, wp.Function]:
    """A block's shared memory.

    Args:
        size: of it [bytes], a multiple of 4.

    Returns:
        The words of a tile of int32 in shared memory of that size, and a function from such a tile to its address.
    """
    words = size // 4

    @wp.func_native(on_cuda("return (wp::uint32)__cvta_generic_to_shared(scratch.data.ptr);", "return 0;"))
    def address(scratch: wp.tile[wp.int32, words]) -> Address: ...

    return words, address


# wp.tid() divides for what these registers hold, and its results are kept where registers are short.
@wp.func_native(on_cuda("return (int)threadIdx.x;", "return 0;"))
def thread_of_block() -> int:
    """This thread, counted from the block's first."""


@wp.func_native(on_cuda("return (int)blockIdx.x;", "return 0;"))
def program_of_grid() -> int:
    """This block, counted from the launch's first."""


@wp.func_native(on_cuda("__syncthreads();"))
def sync():
    """All warps of the block have come here, and what they wrote to shared memory is seen."""


@made_once
def team_sync(size: int) -> wp.Function:
    """As ``sync``, among the warps of a team.

    Args:
        size: of a team, of TEAMS.

    Returns:
        A function (team, counted from 0).
    """
    # 0 is the barrier of the whole block
    wait = f"""asm volatile("bar.sync %0, {32 * size};" :: "r"(team + 1) : "memory");"""

    @wp.func_native(on_cuda(wait if size > 1 else ""))
    def wait_for_team(team: int): ...

    return wait_for_team


@wp.func_native(
    on_cuda(
        f"""{PACK}
        for (int k = thread; k < rows * columns; k += {THREADS}) {{
            const int row = k / columns, column = k - row * columns;
            const bool given = row < w.shape[0] && column < w.shape[1];
            const unsigned short x = (unsigned short)pack(given ? w.data[row * w.shape[1] + column] : 0.0f, 0.0f);
            asm volatile("st.shared.b16 [%0], %1;"
                :: "r"(address + row * (2 * columns + {PADDING}) + 2 * column), "h"(x) : "memory");
        }}"""
    )
)
def load_weight(w: MATRIX, rows: int, columns: int, address: Address, thread: int):
    """Writes a weight [., .] to shared memory, in float16 and padded with zeros to rows x columns."""


@wp.func_native(
    on_cuda(
        f"""for (int k = thread; k < columns; k += {THREADS})
            asm volatile("st.shared.f32 [%0], %1;"
                :: "r"(address + 4 * k), "f"(k < b.shape[0] ? b.data[k] : 0.0f) : "memory");"""
    )
)
def load_bias(b: ARRAY, columns: int, address: Address, thread: int):
    """Writes a bias to shared memory, padded with zeros."""


@made_once
def feature_reader(inputs: int) -> wp.Function:
    """What brings a warp's pixels from a matrix [pixels, channels], any distance apart, and a 1 behind the channels.

    What multiplies the 1 is summed like a weight's gradient, and is a bias's.

    Returns:
        A function (matrix, first pixel, lane) -> packed.
    """
    packed = fragments(inputs).packed
    snippet = f"wp::vec_t<{inputs // 4}, wp::uint32> p;" + on_cuda(
        f"""{PACK}
        const int channels = features.shape[1], column = 2 * (lane & 3);
        #pragma unroll
        for (int k = 0; k < {inputs // 4}; ++k) {{
            const int row = pixel + (lane >> 2) + 8 * (k & 1), from = column + 8 * (k >> 1);
            const float* at = (const float*)((const char*)features.data + (long long)row * features.strides[0]);
            const bool inside = row < features.shape[0];
            float x[2];
            #pragma unroll
            for (int i = 0; i < 2; ++i)
                x[i] = from + i < channels ? (inside ? at[from + i] : 0.0f) : from + i == channels ? 1.0f : 0.0f;
            p.c[k] = pack(x[0], x[1]);
        }}"""
    )

    @wp.func_native(snippet + "return p;")
    def read_features(features: MATRIX, pixel: int, lane: int) -> packed: ...

    return read_features


@wp.func_native("return exp2f(-ceilf(log2f(fmaxf(largest, 1e-30f))));")
def factor_of(largest: wp.float32) -> wp.float32:
    """The power of two that brings gradients up to so large a one into float16's range, to at most 1."""


@wp.func_native("return exp2f(ceilf(log2f(fmaxf(largest, 1e-30f))));")
def unscaled_of(largest: wp.float32) -> wp.float32:
    """The power of two that takes them back: 1 / ``factor_of``, without a division."""


@wp.func_native(
    on_cuda(
        f"""{SIGMOID}
        const int channels = image.shape[1], column = 2 * (lane & 3);
        #pragma unroll
        for (int k = 0; k < 4; ++k) {{
            const int row = pixel + (lane >> 2) + 8 * (k >> 1), c = column + (k & 1);
            if (row < image.shape[0] && c < channels)
                image.data[(long long)row * channels + c] = sigmoid(z.c[k]);
        }}"""
    )
)
def write_image(z: _sums, image: MATRIX, pixel: int, lane: int):
    """A warp's pixels, y = sigmoid(z), to an image [pixels, channels] of at most 8 channels."""


read_gradient_snippet = "wp::vec_t<8, wp::float32> v;" + on_cuda(
    """const int channels = image.shape[1], column = 2 * (lane & 3);
    #pragma unroll
    for (int k = 0; k < 8; ++k) {
        const int row = pixel + (lane >> 2) + 8 * (k >> 1 & 1), c = column + (k & 1);
        v.c[k] = 0.0f;
        if (k < 4 && row < image.shape[0] && c < channels) {
            const long long at = (long long)row * channels + c;
            const float y = image.data[at];
            v.c[k] = v_image.data[at] * y * (1.0f - y) * factor;
        }
    }"""
)


@wp.func_native(read_gradient_snippet + "return v;")
def read_gradient(image: MATRIX, v_image: MATRIX, factor: wp.float32, pixel: int, lane: int) -> _sums:
    """Scaled gradient to z of an image [pixels, channels] that is sigmoid(z)."""


@made_once
def feature_writer(inputs: int) -> wp.Function:
    """What brings a warp's pixels to a matrix [pixels, channels], scaled back.

    Returns:
        A function (sums, matrix, what to multiply by, first pixel, lane).
    """
    sums = fragments(inputs).sums
    snippet = on_cuda(
        f"""const int channels = v_features.shape[1], column = 2 * (lane & 3);
        #pragma unroll
        for (int k = 0; k < {inputs // 2}; ++k) {{
            const int row = pixel + (lane >> 2) + 8 * (k >> 1 & 1), c = column + (k & 1) + 8 * (k >> 2);
            if (row < v_features.shape[0] && c < channels)
                v_features.data[(long long)row * channels + c] = v.c[k] * unscaled;
        }}"""
    )

    @wp.func_native(snippet)
    def write_features(v: sums, v_features: MATRIX, unscaled: wp.float32, pixel: int, lane: int): ...

    return write_features


@made_once
def stored(down: int, across: int) -> wp.Function:
    """Stores a part of a weight's gradient, of it what is not padding.

    Args:
        down: 16 rows each.
        across: 8 columns each.

    Returns:
        A function (sums as ``add_outer`` gives them, array, the weight's place in it, the weight's rows and columns,
        the part's first row and column, whether a further column is the bias's, factor, lane).
    """
    total = wp.types.vector(4 * down * across, wp.float32)
    snippet = on_cuda(
        f"""#pragma unroll
        for (int m = 0; m < {down}; ++m)
            #pragma unroll
            for (int n = 0; n < {across}; ++n)
                #pragma unroll
                for (int k = 0; k < 4; ++k) {{
                    const int r = row + 16 * m + (lane >> 2) + 8 * (k >> 1);
                    const int c = column + 8 * n + 2 * (lane & 3) + (k & 1);
                    const float x = v.c[4 * (m * {across} + n) + k] * unscaled;
                    if (r < rows && c < columns) out.data[first + r * columns + c] = x;
                    if (r < rows && c == columns && with_bias) out.data[first + rows * columns + r] = x;
                }}"""
    )

    @wp.func_native(snippet)
    def store(
        v: total, out: ARRAY, first: int, rows: int, columns: int, row: int, column: int, with_bias: bool,
        unscaled: wp.float32, lane: int,
    ): ...  # fmt: skip

    return store


@wp.func_native(
    on_cuda(
        """if ((lane & 3) == place >> 1) {
            const int r = row + (lane >> 2);
            if (r < rows) out.data[first + r] = v.c[place & 1] * unscaled;
            if (r + 8 < rows) out.data[first + r + 8] = v.c[2 + (place & 1)] * unscaled;
        }"""
    )
)
def store_sums(v: FOUR, place: int, out: ARRAY, first: int, rows: int, row: int, unscaled: wp.float32, lane: int):
    """What add_columns summed in a place, to a bias's place from ``first`` on."""
