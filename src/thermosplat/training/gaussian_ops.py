"""Operations that change which Gaussians there are: parameters and optimizer state together.

``gaussians`` is any module whose parameters share their first dimension N (``gaussians.Gaussians``), ``optimizers`` has
one Adam for each parameter name. New Gaussians start with zero moments, as in gsplat. Every operation first makes all
the new tensors and then puts them in place, so that running out of memory half-way leaves the Gaussians as they were.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

Optimizers = dict[str, torch.optim.Adam]
"""One optimizer for each parameter name of a set of Gaussians."""

SPLIT_SCALE = 1.6
"""The two halves of a split Gaussian are this much smaller. 3DGS: 0.8 x 2."""


@contextmanager
def opacities_restored(gaussians: nn.Module) -> Iterator[None]:
    """A block that may overwrite opacities; behind it all are as they were.

    Args:
        gaussians: The Gaussians.
    """
    saved = [(value, value.detach().clone()) for name, value in gaussians.named_parameters() if "opacit" in name]
    try:
        yield
    finally:
        with torch.no_grad():
            for value, before in saved:
                value.copy_(before)


@torch.no_grad()
def clone(gaussians: nn.Module, optimizers: Optimizers, selected: Tensor) -> None:
    """Append a copy of each selected Gaussian.

    Args:
        gaussians: The Gaussians, N of them.
        optimizers: Their optimizers.
        selected: Boolean, shape [N].
    """
    append_copies(gaussians, optimizers, torch.where(selected)[0])


@torch.no_grad()
def append_copies(gaussians: nn.Module, optimizers: Optimizers, indices: Tensor) -> None:
    """Append a copy of each named Gaussian, of a repeated one several.

    Args:
        gaussians: The Gaussians, N of them.
        optimizers: Their optimizers.
        indices: int64, shape [n].
    """
    number = len(next(gaussians.parameters()))
    added = {name: parameter[indices] for name, parameter in gaussians.named_parameters()}
    _rebuild(gaussians, optimizers, torch.arange(number, device=indices.device), added)


@torch.no_grad()
def clear_moments(gaussians: nn.Module, optimizers: Optimizers, indices: Tensor) -> None:
    """Let Adam forget what it knows of some Gaussians.

    Args:
        gaussians: The Gaussians.
        optimizers: Their optimizers.
        indices: int64, shape [n].
    """
    for name, parameter in gaussians.named_parameters():
        for key, moment in optimizers[name].state.get(parameter, {}).items():
            if key != "step":
                moment[indices] = 0.0


@torch.no_grad()
def grow(
    gaussians: nn.Module, optimizers: Optimizers, cloned: Tensor, halved: Tensor, generator: torch.Generator
) -> None:
    """Append copies of some Gaussians, and replace others by two smaller ones drawn from their distribution. 3DGS.

    Args:
        gaussians: The Gaussians, N of them. What is left of them comes first, then the copies, then the halves.
        optimizers: Their optimizers.
        cloned: Boolean, shape [N].
        halved: Boolean, shape [N].
        generator: Draws the new means; a CPU generator, so that every device draws the same.
    """
    parameters = dict(gaussians.named_parameters())
    copies, indices = torch.where(cloned)[0], torch.where(halved)[0]  # every selection by a mask waits for the device
    scales = parameters["log_scales"][indices].exp()
    noise = torch.randn(2, *scales.shape, generator=generator, dtype=scales.dtype).to(scales.device)
    samples = rotate(parameters["quats"][indices], noise * scales)  # [2, n, 3]

    added = {}
    for name, parameter in parameters.items():
        halves = parameter[indices].repeat(2, *[1] * (parameter.dim() - 1))
        if name == "means":
            halves += samples.reshape(-1, 3)
        elif name == "log_scales":
            halves -= math.log(SPLIT_SCALE)
        added[name] = torch.cat([parameter[copies], halves])
    _rebuild(gaussians, optimizers, torch.where(~halved)[0], added)


@torch.no_grad()
def prune(gaussians: nn.Module, optimizers: Optimizers, removed: Tensor) -> None:
    """Remove Gaussians.

    Args:
        gaussians: The Gaussians, N of them.
        optimizers: Their optimizers.
        removed: Boolean, shape [N].
    """
    added = {name: parameter[:0] for name, parameter in gaussians.named_parameters()}
    _rebuild(gaussians, optimizers, torch.where(~removed)[0], added)


@torch.no_grad()
def become_copy(gaussians: nn.Module, optimizers: Optimizers, source: nn.Module) -> None:
    """Replace all Gaussians by copies of another set's; their moments start from zero.

    Args:
        gaussians: The Gaussians to replace.
        optimizers: Their optimizers.
        source: Gaussians with parameters of the same names.
    """
    nobody = torch.zeros(0, dtype=torch.int64, device=next(gaussians.parameters()).device)
    added = dict(source.named_parameters())
    _rebuild(gaussians, optimizers, nobody, {name: added[name] for name, _ in gaussians.named_parameters()})


@torch.no_grad()
def reset_opacities(gaussians: nn.Module, optimizers: Optimizers, max_opacity: float) -> None:
    """Lower every opacity to at most ``max_opacity``, so that only Gaussians the images need come back. 3DGS.

    The thermal opacity is lowered likewise, by itself: a Gaussian that was fainter than the limit
    in one spectrum stays as faint in it. Moments of both parameters start again from zero.

    Args:
        gaussians: The Gaussians.
        optimizers: Their optimizers.
        max_opacity: In (0, 1).
    """
    parameters = dict(gaussians.named_parameters())
    limit = math.log(max_opacity / (1.0 - max_opacity))
    logits, offsets = parameters["logit_opacities"], parameters.get("thermal_opacity_offsets")
    new_logits = logits.clamp(max=limit)
    if offsets is not None:
        offsets.copy_((logits + offsets).clamp(max=limit) - new_logits)
    logits.copy_(new_logits)
    if "logit_thermal_opacities" in parameters:
        parameters["logit_thermal_opacities"].clamp_(max=limit)

    for name in ("logit_opacities", "thermal_opacity_offsets", "logit_thermal_opacities"):
        if name in parameters:
            for key, value in optimizers[name].state.get(parameters[name], {}).items():
                if key != "step":
                    value.zero_()


def _rebuild(gaussians: nn.Module, optimizers: Optimizers, kept: Tensor, added: dict[str, Tensor]) -> None:
    """Make the Gaussians those of indices ``kept`` followed by ``added``, in every parameter and its moments."""
    replacements = {}
    for name, parameter in gaussians.named_parameters():
        new = nn.Parameter(_chosen(parameter, kept, added[name]), requires_grad=parameter.requires_grad)
        state = dict(optimizers[name].state.get(parameter, {}))
        for key, moment in state.items():
            if key != "step":
                state[key] = _chosen(moment, kept, torch.zeros_like(added[name]))
        replacements[name] = (parameter, new, state)

    for name, (parameter, new, state) in replacements.items():
        setattr(gaussians, name, new)
        optimizers[name].param_groups[0]["params"] = [new]
        optimizers[name].state.pop(parameter, None)
        if state:
            optimizers[name].state[new] = state


def _chosen(values: Tensor, kept: Tensor, added: Tensor) -> Tensor:
    """Rows ``kept`` of values, then ``added``; as ``torch.cat([values[kept], added])`` in half its time."""
    new = values.new_empty(len(kept) + len(added), *values.shape[1:])
    torch.index_select(values, 0, kept, out=new[: len(kept)])
    new[len(kept) :] = added
    return new


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors [..., n, 3] by quaternions [n, 4] (wxyz, any length): v + 2w (u x v) + 2 u x (u x v)."""
    w, u = nn.functional.normalize(quats, dim=-1).split((1, 3), dim=-1)
    u = u.expand_as(vectors)
    uv = torch.linalg.cross(u, vectors)
    return vectors + 2.0 * (w * uv + torch.linalg.cross(u, uv))
