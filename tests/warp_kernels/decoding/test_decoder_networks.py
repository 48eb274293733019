"""The decoders' kernels give images and gradients of the networks they stand for; see decoder_emulation.py."""

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import silu

from decoder_emulation import Array, Block, Rows
from warp_kernels.decoding.decoder_adjoint import decode_adjoint_kernel
from warp_kernels.decoding.decoder_memory import TEAMS, layout_of, padded_inputs
from warp_kernels.decoding.decoder_networks import HIDDEN, decode_kernel

pytestmark = pytest.mark.rotating

PIXELS, PROGRAMS = 300, 2
"""More than two blocks decode at once, and no multiple of what one does."""

FLOAT16 = 5e-3
"""Relative error (norm) after five layers in float16."""


class Case(NamedTuple):
    """Features, parameters (None without a modulation), the image's gradient; from float64 image and gradients."""

    features: Array
    parameters: list[Array | None]
    v_image: Array
    image: Array
    v_features: Array
    v_parameters: list[Array]


def case(hidden: int, modulated: bool, dim: int, channels: int) -> Case:
    """Random networks on random features, with gradients as small as those of a mean over many pixels."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(hidden, dim), (hidden,), *[(hidden, hidden), (hidden,)] * 2]
    shapes += [(2 * hidden, hidden), (2 * hidden,)] if modulated else []
    shapes += [(channels, hidden), (channels,)]

    def noise(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    features, v_image = noise(PIXELS, dim).requires_grad_(), 1e-7 * noise(PIXELS, channels)
    parameters = [(0.3 * noise(*shape)).requires_grad_() for shape in shapes]
    w1, b1, w2, b2, w3, b3, *modulation, wh, bh = parameters
    encoded = silu(silu(features @ w1.T + b1) @ w2.T + b2)
    top = silu(encoded @ w3.T + b3)
    if modulated:
        gamma, beta = (top @ modulation[0].T + modulation[1]).chunk(2, -1)
        top = gamma * encoded + beta
    image = torch.sigmoid(top @ wh.T + bh)
    v_features, *v_parameters = torch.autograd.grad(image, [features, *parameters], v_image)
    given = [single(parameter) for parameter in parameters]
    if not modulated:
        given[6:6] = [None, None]
    wanted = single(image), single(v_features), [single(v) for v in v_parameters]
    return Case(single(features), given, single(v_image), *wanted)


def single(tensor: Tensor) -> Array:
    """In float32."""
    return tensor.detach().float().numpy()


def arguments(parameters: list[Array | None]) -> list[Rows]:
    """Parameters as the kernels take them: the first layer stands for a modulation that is not there."""
    return [Rows(parameters[k % 2] if value is None else value) for k, value in enumerate(parameters)]


def apart(found: Array, wanted: Array) -> float:
    """Relative difference (norm); what was not written is not a number, and so is this."""
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize("modulated", [False, True])
@pytest.mark.parametrize("dim", [8, 24])
def test_every_pixel_is_decoded(hidden: int, modulated: bool, dim: int) -> None:
    """Every pixel is decoded, from features of either width."""
    given, image = case(hidden, modulated, dim, 3), np.full((PIXELS, 3), np.nan, np.float32)
    shape = hidden, modulated, padded_inputs(dim)
    layout = layout_of(*shape)
    for program in range(PROGRAMS):
        block = Block(*shape, 1, layout, layout.forward_size)
        inputs = [PROGRAMS, Rows(given.features), *arguments(given.parameters), Rows(image)]
        block.run(decode_kernel(*shape), program, inputs)
    assert apart(image, given.image) < FLOAT16


@pytest.mark.parametrize("team", TEAMS)
@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize(
    ("modulated", "dim", "channels"), [(False, 5, 1), (True, 15, 8), (False, 24, 3), (True, 31, 8)]
)
def test_gradients_of_features_and_parameters(hidden: int, modulated: bool, dim: int, channels: int, team: int) -> None:
    """Gradients of features and of every weight and bias, with one warp or two for 16 pixels."""
    given = case(hidden, modulated, dim, channels)
    shape = hidden, modulated, padded_inputs(dim)
    layout = layout_of(*shape, team)
    sizes = [v.size for v in given.v_parameters]
    v_features, partial = (np.full(shape, np.nan, np.float32) for shape in ((PIXELS, dim), (PROGRAMS, sum(sizes))))
    images = [Rows(given.image), Rows(given.v_image), Rows(np.abs(given.v_image).max(keepdims=True)[0])]
    for program in range(PROGRAMS):
        block = Block(*shape, team, layout, layout.size)
        inputs = [PROGRAMS, Rows(given.features), *images, *arguments(given.parameters)]
        kernel = decode_adjoint_kernel(*shape, team)
        block.run(kernel, program, [*inputs, Rows(v_features), Rows(partial)])
    assert apart(v_features, given.v_features) < FLOAT16
    for found, wanted in zip(np.split(partial.sum(0), np.cumsum(sizes)[:-1]), given.v_parameters, strict=True):
        assert apart(found, wanted.ravel()) < FLOAT16
