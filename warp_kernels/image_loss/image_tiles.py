"""Tiles of an image channel under SSIM's window, blurred along rows and columns without leaving the chip.

A block of threads has one tile of one channel. It puts what is blurred into shared memory with a margin of the window's
radius, blurs all rows of that into a second buffer, and then columns of that buffer: five moments a pixel would
otherwise be written and read back, which took longer than to compute them. A thread makes ``STRIP`` neighbouring
outputs at once, so that a value is read a few times, not 11. Rows of both buffers are an odd number of values apart:
lanes that walk rows, as the first blur does, then meet in no bank.

On the CPU a block is one thread, its buffers lie on the stack, and the rest is the same.
"""

import math

import warp as wp

RADIUS = 5
"""Taps on each side of the window's centre [px]: 11 in all. Wang et al. 2004, 3DGS."""

STRIP = 4
"""Outputs of a thread."""

THREADS = 128
"""Threads a block on CUDA."""

WIDTH = 32
"""Columns of a tile."""

MARGINED = WIDTH + 2 * RADIUS
"""Columns of a tile with its margins; ``PITCH`` and ``BLURRED_PITCH`` lie between rows of the buffers."""

PITCH = MARGINED + 1
BLURRED_PITCH = WIDTH + 1


def tile_height(dtype: type) -> int:
    """Rows of a tile, as many as shared memory has room for."""
    return 32 if dtype is wp.float32 else 8


def tiles_of(height: int, width: int, dtype: type) -> int:
    """Tiles of an image.

    Args:
        height: [px].
        width: [px].
    """
    return -(-height // tile_height(dtype)) * -(-width // WIDTH)


def threads_of(device: wp.Device) -> int:
    """Threads a block."""
    return THREADS if device.is_cuda else 1


def window(sigma: float) -> list[float]:
    """The Gaussian window, summing to 1.

    Args:
        sigma: standard deviation [px].

    Returns:
        2 RADIUS + 1 numbers.
    """
    taps = [math.exp(-(k**2) / (2.0 * sigma**2)) for k in range(-RADIUS, RADIUS + 1)]
    return [tap / sum(taps) for tap in taps]


def buffers(sources: int, planes: int, sigma: float, dtype: type) -> str:
    """Source that declares the buffers, the window's taps ``w`` and what is different on the CPU.

    ``fetch`` reads a number that nobody writes meanwhile: the compiler, which then knows that it does not lie in a
    buffer, asks for several at once.

    Args:
        sources: images that are put into shared memory: ``held``.
        planes: images that are blurred: ``blurred``.
        sigma: standard deviation of the window [px].
    """
    rows = tile_height(dtype) + 2 * RADIUS
    arrays = f"S_ held[{sources}][{rows * PITCH}], blurred[{planes}][{rows * BLURRED_PITCH}];"
    taps = ", ".join(f"(S_){tap!r}" for tap in window(sigma))
    return f"""
#if defined(__CUDA_ARCH__)
    __shared__ {arrays}
    const int threads = {THREADS};
    const auto fetch = [](const S_* numbers, long long at) {{ return __ldg(numbers + at); }};
#else
    {arrays}
    const int threads = 1;
    const auto fetch = [](const S_* numbers, long long at) {{ return numbers[at]; }};
#endif
    const S_ w[{2 * RADIUS + 1}] = {{{taps}}};
"""


SYNC = """
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
"""


def fill(dtype: type, statement: str) -> str:
    """Source that walks the tile with its margins.

    Args:
        statement: sets ``held[...][at]`` for row ``gy`` and column ``gx`` of the image, which may lie outside.
    """
    return f"""
    #pragma unroll 4
    for (int item = thread; item < {(tile_height(dtype) + 2 * RADIUS) * MARGINED}; item += threads) {{
        const int row = item / {MARGINED}, column = item - row * {MARGINED}, at = row * {PITCH} + column;
        const int gy = y0 + row - {RADIUS}, gx = x0 + column - {RADIUS};
        {statement}
    }}
    {SYNC}
"""


def blur_rows(dtype: type, planes: int, values: str, borders: str = "") -> str:
    """Source that blurs what is held along rows.

    Args:
        values: these at index ``at`` of what is held, in braces.
        borders: adds to the sums ``t``; see ``mirrored``.
    """
    rows = tile_height(dtype) + 2 * RADIUS
    return f"""
    for (int task = thread; task < {rows * WIDTH // STRIP}; task += threads) {{
        const int first = task / {rows} * {STRIP}, row = task % {rows}, begin = row * {PITCH} + first;
        {_strip(planes, values, "begin + k")}
        {borders}
        for (int p = 0; p < {planes}; ++p)
            #pragma unroll
            for (int r = 0; r < {STRIP}; ++r) blurred[p][row * {BLURRED_PITCH} + first + r] = t[p][r];
    }}
    {SYNC}
"""


def blur_columns(dtype: type, planes: int, statement: str, borders: str = "") -> str:
    """Source that blurs along columns what is blurred along rows.

    Args:
        statement: uses the sums ``t[...][r]`` of row ``gy`` and column ``gx`` of the image.
        borders: adds to the sums ``t``; see ``mirrored``.
    """
    values = ", ".join(f"blurred[{p}][at]" for p in range(planes))
    return f"""
    for (int task = thread; task < {tile_height(dtype) * WIDTH // STRIP}; task += threads) {{
        const int column = task % {WIDTH}, first = task / {WIDTH} * {STRIP}, begin = first * {BLURRED_PITCH} + column;
        const int gx = x0 + column;
        {_strip(planes, f"{{{values}}}", f"begin + k * {BLURRED_PITCH}")}
        {borders}
        #pragma unroll
        for (int r = 0; r < {STRIP}; ++r) {{
            const int gy = y0 + first + r;
            if (gy < height && gx < width) {{
                {statement}
            }}
        }}
    }}
"""


def _strip(planes: int, values: str, place: str) -> str:
    """Sums ``t`` of each plane under the window at STRIP neighbouring places."""
    return f"""
        S_ t[{planes}][{STRIP}] = {{}};
        #pragma unroll
        for (int k = 0; k < {STRIP + 2 * RADIUS}; ++k) {{
            const int at = {place};
            const S_ v[{planes}] = {values};
            #pragma unroll
            for (int r = 0; r < {STRIP}; ++r)
                if (k >= r && k - r <= {2 * RADIUS})
                    #pragma unroll
                    for (int p = 0; p < {planes}; ++p) t[p][r] += w[k - r] * v[p];
        }}
"""


def mirrored(planes: int, start: str, size: str, values: str, place: str) -> str:
    """Source of the adjoint of a reflection at the borders: an output gets what its mirror images receive, too.

    Of place i those are -i and 2 (size - 1) - i, of whose windows only the taps towards the image meet it.

    Args:
        start: the image's row or column in which the strip begins.
        values: the images at index ``at`` of their buffer, in braces.
        place: ``at`` for the image's row or column ``j``.
    """
    add = f"""
                const int at = {place};
                const S_ v[{planes}] = {values};
                #pragma unroll
                for (int p = 0; p < {planes}; ++p) t[p][r] += w[{RADIUS} + k] * v[p];
"""
    return f"""
        const int start = {start}, last = {size} - 1;
        if (start <= {RADIUS} || start + {STRIP + RADIUS} > last) {{
            #pragma unroll
            for (int r = 0; r < {STRIP}; ++r) {{
                const int i = start + r;
                #pragma unroll
                for (int k = 1; k <= {RADIUS}; ++k) {{
                    if (i > 0 && k >= i) {{ const int j = k - i; {add} }}
                    if (i < last && k >= last - i) {{ const int j = 2 * last - i - k; {add} }}
                }}
            }}
        }}
"""
