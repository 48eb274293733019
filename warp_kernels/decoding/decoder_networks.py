"""The decoders' two branches, features to image, a warp's 16 pixels at a time on tensor cores.

Two linear layers with SiLU, the prior's, in the RGB branch its modulation γ ⊙ h + β, the head with a sigmoid. A block
of WARPS warps reads the weights into shared memory once and takes every so many-th block of pixels. Activations stay
in registers.

Operands are float16, with TensorFloat-32's 10 bits of mantissa; sums are float32. CUDA only (sm_80 and later). See
decoder_adjoint.py for the way back.
"""

import warp as wp

from warp_kernels.decoding.decoder_memory import (
    ARRAY,
    INPUTS,
    MATRIX,
    NARROW,
    THREADS,
    WARPS,
    feature_reader,
    layout_of,
    load_bias,
    load_weight,
    program_of_grid,
    shared_address,
    sync,
    thread_of_block,
    write_image,
)
from warp_kernels.decoding.matrix_fragments import PIXELS, Address, fragments, linear, row_bytes
from warp_kernels.machinery.loading import made_once

HIDDEN = (32, 64)
"""Channels of hidden layers that there are kernels for."""


def label_of(hidden: int, modulated: bool, inputs: int) -> str:
    """Name of the kernels of a branch; the arguments are those of ``decode_kernel``."""
    return f"decode_{hidden}{'_modulated' if modulated else ''}{'' if inputs == INPUTS[0] else f'_inputs{inputs}'}"


@made_once
def parameter_loader(hidden: int, modulated: bool, inputs: int) -> wp.Function:
    """What brings a block's weights and biases to shared memory.

    Args:
        hidden: channels of hidden layers, of HIDDEN.
        modulated: whether there is a modulation.
        inputs: columns of features, of INPUTS.

    Returns:
        A function (address of the block's shared memory, weights and biases in the kernels' order, thread), after
        which all threads may read them.
    """
    at = layout_of(hidden, modulated, inputs)

    @wp.func
    def load_parameters(
        base: Address,
        w1: MATRIX, b1: ARRAY, w2: MATRIX, b2: ARRAY, w3: MATRIX, b3: ARRAY,
        wm: MATRIX, bm: ARRAY, wh: MATRIX, bh: ARRAY,
        thread: int,
    ):  # fmt: skip
        load_weight(w1, hidden, inputs, base + Address(wp.static(at.w1)), thread)
        load_weight(w2, hidden, hidden, base + Address(wp.static(at.w2)), thread)
        load_weight(w3, hidden, hidden, base + Address(wp.static(at.w3)), thread)
        load_weight(wh, NARROW, hidden, base + Address(wp.static(at.head)), thread)
        load_bias(b1, hidden, base + Address(wp.static(at.b1)), thread)
        load_bias(b2, hidden, base + Address(wp.static(at.b2)), thread)
        load_bias(b3, hidden, base + Address(wp.static(at.b3)), thread)
        load_bias(bh, NARROW, base + Address(wp.static(at.b_head)), thread)
        if wp.static(modulated):
            load_weight(wm, 2 * hidden, hidden, base + Address(wp.static(at.modulation)), thread)
            load_bias(bm, 2 * hidden, base + Address(wp.static(at.b_modulation)), thread)
        sync()

    return load_parameters


@made_once
def decode_kernel(hidden: int, modulated: bool, inputs: int) -> wp.Kernel:
    """The forward kernel of a branch.

    Args:
        hidden: channels of hidden layers, of HIDDEN.
        modulated: whether there is a modulation.
        inputs: columns of features, of INPUTS.

    Returns:
        A kernel, launched with (programs, THREADS) threads in blocks of THREADS, two of which fit on a multiprocessor.
    """
    at = layout_of(hidden, modulated, inputs)
    load_parameters, read_features = parameter_loader(hidden, modulated, inputs), feature_reader(inputs)
    wide = fragments(hidden)
    rounded, widened, silu = wide.rounded, wide.widened, wide.silu
    (first_layer, _), (layer, layer_added), (head, _) = (
        linear(columns, outputs) for columns, outputs in ((inputs, hidden), (hidden, hidden), (hidden, NARROW))
    )
    gamma_to_beta = hidden * row_bytes(hidden)
    pixels_of_block = WARPS * PIXELS
    words, address = shared_address(at.forward_size)

    @wp.kernel(
        name=label_of(hidden, modulated, inputs),
        enable_backward=False,
        module="unique",
        launch_bounds=(THREADS, 2),
        grid_stride=False,
    )
    def decode(
        programs: int,
        features: MATRIX,
        w1: MATRIX, b1: ARRAY, w2: MATRIX, b2: ARRAY, w3: MATRIX, b3: ARRAY,
        wm: MATRIX, bm: ARRAY, wh: MATRIX, bh: ARRAY,
        image: MATRIX,
    ):  # fmt: skip
        program, thread = program_of_grid(), thread_of_block()
        base = address(wp.tile_empty(shape=words, dtype=wp.int32, storage="shared"))
        load_parameters(base, w1, b1, w2, b2, w3, b3, wm, bm, wh, bh, thread)
        lane = thread & 31
        pixel = program * pixels_of_block + (thread >> 5) * PIXELS
        following = read_features(features, pixel, lane)
        while pixel < image.shape[0]:
            x = following
            following = read_features(features, pixel + programs * pixels_of_block, lane)  # while these are decoded
            a = silu(first_layer(x, base + Address(wp.static(at.w1)), base + Address(wp.static(at.b1)), lane))
            encoded = silu(layer(a, base + Address(wp.static(at.w2)), base + Address(wp.static(at.b2)), lane))
            top = silu(layer(encoded, base + Address(wp.static(at.w3)), base + Address(wp.static(at.b3)), lane))
            if wp.static(modulated):
                modulation = base + Address(wp.static(at.modulation))
                b_modulation = base + Address(wp.static(at.b_modulation))
                gamma = layer(top, modulation, b_modulation, lane)
                modulated_sums = wp.cw_mul(gamma, widened(encoded))
                of_beta = modulation + Address(gamma_to_beta)
                top = rounded(layer_added(top, of_beta, b_modulation + Address(4 * hidden), modulated_sums, lane))
            z = head(top, base + Address(wp.static(at.head)), base + Address(wp.static(at.b_head)), lane)
            write_image(z, image, pixel, lane)
            pixel += programs * pixels_of_block

    return decode
