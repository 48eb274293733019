"""Small matrix products by one CUDA warp on tensor cores, as functions of Warp kernels.

A warp holds a matrix of 16 rows in its lanes' registers, as ``mma.m16n8k16`` wants it (PTX ISA, "Matrix Fragments"):
lane 4 g + t has the columns 2 t and 2 t + 1 of every 8, in the rows g and g + 8. Summed in float32 it has four numbers
a lane and 8 columns ("sums"); as the next product's operand the same numbers in float16, two a register ("packed"). So
one layer follows the other without leaving the registers. The other operand, and factors of which the transpose is
wanted, lie in shared memory, rows 16 bytes longer than they need be: that brings each row to other banks.

Numbers beyond float16 become the largest there is and not infinite, which times 0 would be NaN.

The functions have bodies on CUDA (sm_80 and later) only.
"""

from typing import Any, NamedTuple

import warp as wp

from warp_kernels.machinery.lanes import on_cuda
from warp_kernels.machinery.loading import made_once

PIXELS = 16
"""Rows of a warp's matrix."""

PADDING = 16
"""Bytes behind each row in shared memory."""

Address = wp.uint32
"""In shared memory, as PTX wants it."""

MMA = """
    auto multiply_add = [](float* c, const unsigned* a, const unsigned b0, const unsigned b1) {
        asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
            : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
            : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
    };
"""

# Four matrices of 8 x 8, of which each lane names a row; transposed or not.
LOAD = """
    auto load = [](unsigned* r, const unsigned address) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
            : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3]) : "r"(address) : "memory");
    };
"""
LOAD_TRANSPOSED = LOAD.replace("auto load", "auto load_transposed").replace("x4.shared", "x4.trans.shared")

PACK = """
    auto pack = [](const float low, const float high, const bool above = true, const bool below = true) {
        unsigned both;
        asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(both) : "f"(high), "f"(low));
        if (above) asm("min.NaN.f16x2 %0, %0, %1;" : "+r"(both) : "r"(0x7bff7bffu));
        if (below) asm("max.NaN.f16x2 %0, %0, %1;" : "+r"(both) : "r"(0xfbfffbffu));
        return both;
    };
"""

# Of approximate powers and quotients those that take one instruction, for the result is rounded to fewer bits.
SIGMOID = """
    auto sigmoid = [](const float z) {
        float power, quotient;
        asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(power) : "f"(-1.4426950408889634f * z));
        asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(quotient) : "f"(1.0f + power));
        return quotient;
    };
"""


def row_bytes(columns: int) -> int:
    """Bytes from one row of float16 in shared memory to the next."""
    return 2 * columns + PADDING


class Fragments(NamedTuple):
    """Functions on a warp's matrices of 16 rows and ``columns`` columns; see ``fragments``."""

    sums: Any
    """Type of float32 numbers a lane."""
    packed: Any
    """Type of float16 numbers a lane, two a register."""
    rounded: wp.Function
    """Sums as operands: (sums) -> packed."""
    widened: wp.Function
    """The reverse: (packed) -> sums."""
    silu: wp.Function
    """z sigmoid(z): (sums) -> packed."""
    silu_slope: wp.Function
    """Its derivative: (sums) -> packed."""
    put: wp.Function
    """Writes a matrix to shared memory: (packed, address of its first number, lane)."""
    get: wp.Function
    """Reads one from there: (address of its first number, lane) -> packed."""


@made_once
def fragments(columns: int, among: int | None = None) -> Fragments:
    """Functions that work on each number.

    Args:
        columns: of the matrices, a multiple of 16.
        among: columns of the matrix in shared memory that these are a part of; None for the same.
    """
    pitch = row_bytes(among or columns)
    registers = columns // 4  # of a packed matrix; twice as many sums
    sums, packed = wp.types.vector(2 * registers, wp.float32), wp.types.vector(registers, wp.uint32)
    each = f"\n#pragma unroll\nfor (int k = 0; k < {registers}; ++k)"
    to_packed = f"wp::vec_t<{registers}, wp::uint32> p;"
    to_sums = f"wp::vec_t<{2 * registers}, wp::float32> z;"

    rounded_snippet = to_packed + on_cuda(PACK + f"{each} p.c[k] = pack(x.c[2 * k], x.c[2 * k + 1]);") + "return p;"
    silu_snippet = (
        to_packed
        + on_cuda(
            f"""{PACK} {SIGMOID}
            auto silu = [&](const float z) {{ return z * sigmoid(z); }};
            {each} p.c[k] = pack(silu(z.c[2 * k]), silu(z.c[2 * k + 1]), true, false);"""
        )
        + "return p;"
    )
    slope_snippet = (
        to_packed
        + on_cuda(
            f"""{PACK} {SIGMOID}
            auto slope = [&](const float z) {{ const float s = sigmoid(z); return s * (1.0f + z * (1.0f - s)); }};
            {each} p.c[k] = pack(slope(z.c[2 * k]), slope(z.c[2 * k + 1]), false, false);"""
        )
        + "return p;"
    )
    widened_snippet = (
        to_sums
        + on_cuda(
            f"""{each}
            asm("{{.reg .b16 low, high; mov.b32 {{low, high}}, %2; cvt.f32.f16 %0, low; cvt.f32.f16 %1, high;}}"
                : "=f"(z.c[2 * k]), "=f"(z.c[2 * k + 1]) : "r"(p.c[k]));"""
        )
        + "return z;"
    )
    put_snippet = on_cuda(
        f"""const unsigned at = address + (lane >> 2) * {pitch} + 4 * (lane & 3);
        {each} asm volatile("st.shared.b32 [%0], %1;"
            :: "r"(at + (k & 1) * {8 * pitch} + (k >> 1) * 16), "r"(p.c[k]) : "memory");"""
    )
    get_snippet = (
        to_packed
        + on_cuda(
            f"""{LOAD}
            const unsigned at = address + (lane & 15) * {pitch} + (lane >> 4) * 16;
            #pragma unroll
            for (int k = 0; k < {registers}; k += 4) load(&p.c[k], at + 8 * k);"""
        )
        + "return p;"
    )

    @wp.func_native(rounded_snippet)
    def rounded(x: sums) -> packed: ...

    @wp.func_native(widened_snippet)
    def widened(p: packed) -> sums: ...

    @wp.func_native(silu_snippet)
    def silu(z: sums) -> packed: ...

    @wp.func_native(slope_snippet)
    def silu_slope(z: sums) -> packed: ...

    @wp.func_native(put_snippet)
    def put(p: packed, address: Address, lane: int): ...

    @wp.func_native(get_snippet)
    def get(address: Address, lane: int) -> packed: ...

    return Fragments(sums, packed, rounded, widened, silu, silu_slope, put, get)


def _products(operand: str, steps: int, tiles: int, load: str, step_bytes: int, tile_bytes: int) -> str:
    """Adds ``operand`` times a matrix in shared memory to ``y``, of which a lane's first row is at ``at``.

    Args:
        operand: packed.
        steps: 16 of its columns each. Where they are even a load brings two of them, otherwise two tiles.
        tiles: 8 columns of ``y`` each.
        step_bytes: from one step to the next in shared memory.
        tile_bytes: from one tile to the next there.
    """
    step, tile = (2, 1) if steps % 2 == 0 else (1, 2)
    # Tiles inside, or neighbouring products would wait for each other.
    return f"""
        #pragma unroll
        for (int j = 0; j < {steps}; j += {step})
            #pragma unroll
            for (int n = 0; n < {tiles}; n += {tile}) {{
                unsigned b[4];
                {load}(b, at + n * {tile_bytes} + j * {step_bytes});
                multiply_add(&y.c[4 * n], &{operand}.c[4 * j], b[0], b[1]);
                multiply_add(&y.c[4 * (n + {tile - 1})], &{operand}.c[4 * (j + {step - 1})], b[2], b[3]);
            }}"""


@made_once
def linear(columns: int, outputs: int) -> tuple[wp.Function, wp.Function]:
    """x Wᵀ + b, of W [outputs, columns] in shared memory.

    Args:
        columns: of x, a multiple of 16.
        outputs: rows of W, a multiple of 16.

    Returns:
        A function (x, address of W, address of b, lane) -> sums, and one (x, address of W, address of b, sums to add
        to, lane) -> sums.
    """
    packed, sums = fragments(columns).packed, fragments(outputs).sums
    pitch, steps = row_bytes(columns), columns // 16
    of_two_steps = f"(lane & 7) * {pitch} + (lane >> 3) * 16"
    of_two_tiles = f"((lane & 7) + 8 * (lane >> 4)) * {pitch} + (lane >> 3 & 1) * 16"

    def snippet(biased: str) -> str:
        return f"wp::vec_t<{outputs // 2}, wp::float32> y;" + on_cuda(
            f"""{MMA} {LOAD}
            #pragma unroll
            for (int n = 0; n < {outputs // 8}; ++n) {{
                float b[2];
                asm volatile("ld.shared.v2.f32 {{%0, %1}}, [%2];" : "=f"(b[0]), "=f"(b[1])
                    : "r"(bias + 32 * n + 8 * (lane & 3)) : "memory");
                #pragma unroll
                for (int k = 0; k < 4; ++k) y.c[4 * n + k] = {biased};
            }}
            const unsigned at = weights + {of_two_steps if steps % 2 == 0 else of_two_tiles};
            {_products("x", steps, outputs // 8, "load", 32, 8 * pitch)}"""
        )

    @wp.func_native(snippet("b[k & 1]") + "return y;")
    def linear(x: packed, weights: Address, bias: Address, lane: int) -> sums: ...

    @wp.func_native(snippet("added.c[4 * n + k] + b[k & 1]") + "return y;")
    def linear_added(x: packed, weights: Address, bias: Address, added: sums, lane: int) -> sums: ...

    return linear, linear_added


@made_once
def linear_adjoint(columns: int, outputs: int, among: int | None = None) -> wp.Function:
    """v W added to sums, of W [outputs, columns] in shared memory.

    Args:
        columns: of W, a multiple of 16.
        outputs: columns of v, a multiple of 16.
        among: columns of the matrix in shared memory that W is a part of; None for the same.

    Returns:
        A function (v, address of W, sums, lane) -> sums.
    """
    packed, sums = fragments(outputs).packed, fragments(columns).sums
    pitch, steps = row_bytes(among or columns), outputs // 16
    of_two_steps, of_two_tiles = f"lane * {pitch}", f"(lane & 15) * {pitch} + (lane >> 4) * 16"
    snippet = f"wp::vec_t<{columns // 2}, wp::float32> y = added;" + on_cuda(
        f"""{MMA} {LOAD_TRANSPOSED}
        const unsigned at = weights + {of_two_steps if steps % 2 == 0 else of_two_tiles};
        {_products("v", steps, columns // 8, "load_transposed", 16 * pitch, 16)}"""
    )

    @wp.func_native(snippet + "return y;")
    def linear_adjoint(v: packed, weights: Address, added: sums, lane: int) -> sums: ...

    return linear_adjoint


@made_once
def add_outer(rows: int, columns: int, outputs: int, inputs: int, matrices: int) -> wp.Function:
    """A part of vᵀ x added to sums, over the rows of several matrices: the gradient of a linear layer's weight.

    Args:
        rows: of the part, a multiple of 16.
        columns: of the part, a multiple of 8.
        outputs: columns of v.
        inputs: columns of x.
        matrices: of 16 rows each, that follow each other in shared memory.

    Returns:
        A function (address of v, address of x, first row, first column, sums, lane) -> sums, four a lane for each 16
        rows and 8 columns.
    """
    down, across = rows // 16, columns // 8
    total = wp.types.vector(4 * down * across, wp.float32)
    # with an odd number of 8 columns the last load's second half goes unused, and may lie in a row's padding
    snippet = f"wp::vec_t<{4 * down * across}, wp::float32> c = added;" + on_cuda(
        f"""{MMA} {LOAD_TRANSPOSED}
        const unsigned at_v = ((lane & 7) + 8 * (lane >> 4)) * {row_bytes(outputs)} + (lane >> 3 & 1) * 16;
        const unsigned of_v = v + at_v + 2 * row;
        const unsigned of_x = x + (lane & 15) * {row_bytes(inputs)} + 2 * column + (lane >> 4) * 16;
        #pragma unroll
        for (int step = 0; step < {matrices}; ++step) {{
            unsigned a[{down}][4];
            #pragma unroll
            for (int m = 0; m < {down}; ++m)
                load_transposed(a[m], of_v + step * {PIXELS * row_bytes(outputs)} + m * 32);
            #pragma unroll
            for (int n = 0; n < {across}; n += 2) {{
                unsigned b[4];
                load_transposed(b, of_x + step * {PIXELS * row_bytes(inputs)} + n * 16);
                #pragma unroll
                for (int m = 0; m < {down}; ++m) {{
                    multiply_add(&c.c[4 * (m * {across} + n)], a[m], b[0], b[1]);
                    if (n + 1 < {across}) multiply_add(&c.c[4 * (m * {across} + n + 1)], a[m], b[2], b[3]);
                }}
            }}
        }}"""
    )

    @wp.func_native(snippet + "return c;")
    def add_outer(v: Address, x: Address, row: int, column: int, added: total, lane: int) -> total: ...

    return add_outer


@made_once
def add_columns(outputs: int, matrices: int) -> wp.Function:
    """Sums of 16 columns of v over the rows of several matrices added to sums: the gradient of a linear layer's bias.

    Args:
        outputs: columns of v.
        matrices: of 16 rows each, that follow each other in shared memory.

    Returns:
        A function (address of v, first column, place, sums, lane) -> sums. Sums of 16 rows and 8 columns have room for
        several such: those of columns g and g + 8 of v come to the rows g and g + 8 of the column ``place``.
    """
    total = wp.types.vector(4, wp.float32)
    snippet = "wp::vec_t<4, wp::float32> c = added;" + on_cuda(
        f"""{MMA} {LOAD_TRANSPOSED}
        const unsigned at_v = ((lane & 7) + 8 * (lane >> 4)) * {row_bytes(outputs)} + (lane >> 3 & 1) * 16;
        const unsigned of_v = v + at_v + 2 * column;
        const unsigned ones = lane >> 2 == place ? 0x3c003c00u : 0u;  // that column of the other factor
        #pragma unroll
        for (int step = 0; step < {matrices}; ++step) {{
            unsigned a[4];
            load_transposed(a, of_v + step * {PIXELS * row_bytes(outputs)});
            multiply_add(c.c, a, ones, ones);
        }}"""
    )

    @wp.func_native(snippet + "return c;")
    def add_columns(v: Address, column: int, place: int, added: total, lane: int) -> total: ...

    return add_columns
