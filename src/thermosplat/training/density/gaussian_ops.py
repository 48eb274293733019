"""Operations that change which Gaussians there are: parameters and optimizer state together.

``gaussians`` is any module whose parameters share their first dimension N (``gaussians.Gaussians``), ``optimizers`` has
one Adam for each parameter name. New Gaussians start with zero moments, as in gsplat. Every operation first makes all
the new tensors and then puts them in place, so that running out of memory half-way leaves the Gaussians as they were.
"""

import math
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from thermosplat.scene.gaussians import OFFSETS
from thermosplat.scene.offloaded import OffloadedParameter
from thermosplat.scene.rotation import rotate
from thermosplat.torch_bridge.host_rows import paired, selected_pair, selected_rows

Optimizers = dict[str, torch.optim.Adam]
"""One optimizer for each parameter name of a set of Gaussians."""

SPLIT_SCALE = 1.6
"""The two halves of a split Gaussian are this much smaller. 3DGS: 0.8 x 2."""


@contextmanager
def opacities_restored(gaussians: nn.Module) -> Iterator[None]:
    """A block that may overwrite opacities; behind it all are as they were."""
    saved = _copies(value for name, value in gaussians.named_parameters() if "opacit" in name)
    try:
        yield
    finally:
        _put_back(saved)


@contextmanager
def kept_on_failure(parameters: Iterable[Tensor]) -> Iterator[None]:
    """A block that may change parameters in place; where it does not come to its end they are as they were."""
    saved = _copies(parameters)
    try:
        yield
    except BaseException:  # Ctrl-C too
        _put_back(saved)
        raise


def _copies(parameters: Iterable[Tensor]) -> list[tuple[Tensor, Tensor]]:
    """Parameters, each with a copy of what it holds."""
    return [(value, value.detach().clone()) for value in parameters]


@torch.no_grad()
def _put_back(saved: list[tuple[Tensor, Tensor]]) -> None:
    for value, before in saved:
        value.copy_(before)


@torch.no_grad()
def clone(gaussians: nn.Module, optimizers: Optimizers, selected: Tensor) -> None:
    """Append a copy of each selected Gaussian.

    Args:
        selected: Boolean, shape [N].
    """
    append_copies(gaussians, optimizers, torch.where(selected)[0])


@torch.no_grad()
def append_copies(gaussians: nn.Module, optimizers: Optimizers, indices: Tensor) -> None:
    """Append a copy of each named Gaussian, of a repeated one several.

    Args:
        indices: int64, shape [n].
    """
    number = len(next(gaussians.parameters()))
    _rebuild(gaussians, optimizers, torch.cat([torch.arange(number, device=indices.device), indices]), number)


@torch.no_grad()
def copy_onto(gaussians: nn.Module, optimizers: Optimizers, replaced: Tensor, sources: Tensor) -> None:
    """Let Gaussians become copies of others. All moments of both start again from zero.

    Args:
        replaced: Indices of those that become copies, int64, shape [n].
        sources: Indices of those they become copies of, none of them replaced itself, int64, shape [n].
    """
    for parameter in gaussians.parameters():
        parameter[replaced] = parameter[sources]
    clear_moments(gaussians, optimizers, torch.cat([replaced, sources]))


@torch.no_grad()
def clear_moments(
    gaussians: nn.Module, optimizers: Optimizers, indices: Tensor, names: Collection[str] | None = None
) -> None:
    """Let Adam forget what it knows of some Gaussians.

    Args:
        indices: Which, int64, shape [n], or boolean, shape [N].
        names: Of these parameters alone. None: of all.
    """
    for name, parameter in gaussians.named_parameters():
        if names is not None and name not in names:
            continue
        for key, moment in optimizers[name].state.get(parameter, {}).items():
            if key != "step":
                moment[indices] = 0.0


@torch.no_grad()
def grow(
    gaussians: nn.Module, optimizers: Optimizers, cloned: Tensor, halved: Tensor, generator: torch.Generator
) -> Tensor:
    """Append copies of some Gaussians, and replace others by two smaller ones drawn from their distribution. 3DGS.

    Args:
        gaussians: The Gaussians, N of them. What is left of them comes first, then the copies, then the halves.
        cloned: Boolean, shape [N].
        halved: Boolean, shape [N].
        generator: Draws the new means; a CPU generator, so that every device draws the same.

    Returns:
        For each Gaussian there is now, which of the former ones it comes from, int64.
    """
    parameters = dict(gaussians.named_parameters())
    copies, indices = torch.where(cloned)[0], torch.where(halved)[0]  # every selection by a mask waits for the device
    scales = parameters["log_scales"][indices].exp()
    noise = torch.randn(2, *scales.shape, generator=generator, dtype=scales.dtype).to(scales.device)
    samples = rotate(parameters["quats"][indices], noise * scales)  # [2, n, 3]

    kept = torch.where(~halved)[0]
    rows = torch.cat([kept, copies, indices, indices])
    _rebuild(gaussians, optimizers, rows, len(kept))
    parameters, first_half = dict(gaussians.named_parameters()), len(rows) - 2 * len(indices)
    parameters["means"][first_half:] += samples.reshape(-1, 3)
    parameters["log_scales"][first_half:] -= math.log(SPLIT_SCALE)
    return rows


@torch.no_grad()
def prune(gaussians: nn.Module, optimizers: Optimizers, removed: Tensor) -> None:
    """Remove Gaussians.

    Args:
        removed: Boolean, shape [N].
    """
    kept = torch.where(~removed)[0]
    _rebuild(gaussians, optimizers, kept, len(kept))


@torch.no_grad()
def become_copy(gaussians: nn.Module, optimizers: Optimizers, source: nn.Module) -> None:
    """Replace all Gaussians by copies of another set's; their moments start from zero.

    Args:
        source: Gaussians with parameters of the same names.
    """
    copied = dict(source.named_parameters())
    replacements = {}
    for name, parameter in gaussians.named_parameters():
        new = parameter_like(parameter, copied[name].detach().clone())
        state = dict(optimizers[name].state.get(parameter, {}))
        replacements[name] = new, {k: v if k == "step" else torch.zeros_like(new) for k, v in state.items()}
    replace_parameters(gaussians, optimizers, replacements)


@torch.no_grad()
def in_new_basis(gaussians: nn.Module, optimizers: Optimizers, name: str, into: Tensor, basis: Tensor) -> None:
    """Replace vectors of Gaussians by their coordinates in a basis.

    Adam's means of gradients are turned exactly, their mean squares as if the gradients' numbers were independent.

    Args:
        name: The parameter, shape [N, d].
        into: What its rows are multiplied by, shape [d, r].
        basis: Orthonormal columns, shape [d, r]; coordinates times its transpose are vectors again.
    """
    parameter = dict(gaussians.named_parameters())[name]
    into, basis = into.to(parameter), basis.to(parameter)
    new = parameter_like(parameter, parameter.detach() @ into)
    turned = {"exp_avg": basis, "exp_avg_sq": basis.square()}
    state = {
        key: value @ turned[key] if key in turned else value
        for key, value in optimizers[name].state.get(parameter, {}).items()
    }
    replace_parameters(gaussians, optimizers, {name: (new, state)})


@torch.no_grad()
def reset_opacities(gaussians: nn.Module, optimizers: Optimizers, max_opacity: float) -> None:
    """Lower every opacity to at most ``max_opacity``, so that only Gaussians the images need come back. 3DGS.

    Other opacities are lowered likewise, each by itself: a Gaussian that was fainter than the limit in one spectrum
    stays as faint in it. Moments of all of them start again from zero.

    Args:
        max_opacity: In (0, 1).
    """
    parameters = dict(gaussians.named_parameters())
    limit = math.log(max_opacity / (1.0 - max_opacity))
    logits = parameters["logit_opacities"]
    new_logits = logits.clamp(max=limit)
    changed = [name for name in parameters if "opacit" in name]
    for name in changed:
        if name.endswith(OFFSETS):
            offsets = parameters[name]
            offsets.copy_((logits + offsets).clamp(max=limit) - new_logits)
        elif name != "logit_opacities":
            parameters[name].clamp_(max=limit)
    logits.copy_(new_logits)

    for name in changed:
        for key, value in optimizers[name].state.get(parameters[name], {}).items():
            if key != "step":
                value.zero_()


def _rebuild(gaussians: nn.Module, optimizers: Optimizers, rows: Tensor, num_kept: int) -> None:
    """Make Gaussian k a copy of the present one ``rows[k]``; the first ``num_kept`` keep their moments."""
    # To look at the state of what is offloaded brings all of it to the host's memory
    states = {name: dict(optimizers[name].state.get(value, {})) for name, value in gaussians.named_parameters()}
    with _offloaded_on_host(gaussians):
        replacements = {}
        for name, parameter in gaussians.named_parameters():
            offloaded, state = isinstance(parameter, OffloadedParameter), states[name]
            select = selected_rows if offloaded else _selected
            new = parameter_like(parameter, select(parameter.detach(), rows))
            if state and offloaded:
                moments = selected_pair(paired(state["exp_avg"], state["exp_avg_sq"], parameter.device), rows)
                moments.buffer[num_kept:].zero_()
                state["exp_avg"], state["exp_avg_sq"] = moments
            else:
                for key in state.keys() - {"step"}:
                    state[key] = _selected(state[key], rows)
                    state[key][num_kept:].zero_()
            replacements[name] = new, state
        replace_parameters(gaussians, optimizers, replacements)


@contextmanager
def _offloaded_on_host(gaussians: nn.Module) -> Iterator[None]:
    """A block that has everything offloaded in the host's memory, so that two of each take none of the device's."""
    try:
        for parameter in gaussians.parameters():
            if isinstance(parameter, OffloadedParameter):
                parameter.go_to_host()
        yield
    finally:
        for parameter in gaussians.parameters():
            if isinstance(parameter, OffloadedParameter):
                parameter.come_back()


def _selected(values: Tensor, rows: Tensor) -> Tensor:
    """Rows of a parameter or of a moment [N, ...]."""
    return torch.index_select(values, 0, rows)


def parameter_like(parameter: nn.Parameter, values: Tensor) -> nn.Parameter:
    """Values as a parameter that is trained as another one is, and lies where that lies."""
    if isinstance(parameter, OffloadedParameter):
        trained = parameter.requires_grad
        return OffloadedParameter.of(values, parameter.device, on_host=parameter.on_host, requires_grad=trained)
    return nn.Parameter(values, requires_grad=parameter.requires_grad)


def replace_parameters(
    gaussians: nn.Module, optimizers: Optimizers, replacements: dict[str, tuple[nn.Parameter, dict[str, Tensor]]]
) -> None:
    """Replace parameters and what their optimizers know of them.

    Args:
        replacements: By name, the parameter and its moments; none where nothing is known.
    """
    parameters = dict(gaussians.named_parameters())
    for name, (new, state) in replacements.items():
        parameter = parameters[name]
        setattr(gaussians, name, new)
        optimizers[name].param_groups[0]["params"] = [new]
        optimizers[name].state.pop(parameter, None)
        if state and isinstance(new, OffloadedParameter):
            moments = paired(state["exp_avg"], state["exp_avg_sq"], new.device)
            state = {**state, "exp_avg": moments.first, "exp_avg_sq": moments.second}
        if state:
            optimizers[name].state[new] = state
