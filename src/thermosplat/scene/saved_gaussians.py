"""Gaussians of a checkpoint: every tensor is held against the configuration and the others before any is used."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.scene.formations.formation import Formation
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.initial_gaussians import sets_of
from thermosplat.scene.packed_parameters import unpack

_BASIS = "feature_basis"


def restored_sets(
    packed: Mapping[str, Mapping[str, Tensor]], config: TrainConfig, formations: Formations
) -> dict[str, Gaussians]:
    """All sets of Gaussians of a scene, by name, as a checkpoint has them.

    Raises:
        KeyError: It lacks a set or a parameter.
        ValueError: As ``restored_gaussians``.
    """
    return {
        name: restored_gaussians(packed[name], config, rendered)
        for name, rendered in sets_of(config.model, formations).items()
    }


def restored_gaussians(packed: Mapping[str, Tensor], config: TrainConfig, formations: Sequence[Formation]) -> Gaussians:
    """Gaussians as a checkpoint has them.

    Args:
        packed: Their parameters (``packed_parameters.pack``).
        formations: Of the spectra that the set renders, in order.

    Raises:
        KeyError: It lacks a parameter.
        ValueError: A parameter is of another shape or type than the configuration and the other ones ask for, or is
            none of theirs.
    """
    number = len(packed["means"])
    for name, value in packed.items():
        whole = name.endswith((".degrees", ".kept"))
        if whole and value.shape != (number,):
            raise ValueError(f"{name} has the shape {list(value.shape)} with {number} Gaussians")
        if value.dtype not in ({torch.uint8, torch.bool} if whole else {torch.float16, torch.float32}):
            raise ValueError(f"{name} holds {value.dtype}")
    parameters = unpack(dict(packed), (config.sh_degree + 1) ** 2 - 1)
    expected = _shapes(config, formations)
    if _BASIS in parameters:
        basis = parameters[_BASIS]
        if basis.ndim != 2 or "features" not in expected or basis.shape[:1] != expected["features"]:
            raise ValueError(f"{_BASIS} has the shape {list(basis.shape)}")
        expected["features"] = basis.shape[1:]
    for name, shape in expected.items():
        if parameters[name].shape != (number, *shape):
            raise ValueError(f"{name} has the shape {list(parameters[name].shape)}, not {[number, *shape]}")
    if strange := parameters.keys() - expected.keys() - {_BASIS}:
        raise ValueError(f"it has no parameter {min(strange)}")
    return Gaussians(parameters)


def num_not_finite(gaussians: Gaussians) -> int:
    """Gaussians that hold a NaN or an infinity, which are not drawn."""
    broken = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for value in gaussians.parameters():
        broken |= ~torch.isfinite(value.detach()).flatten(1).all(dim=1) if value.ndim > 1 else ~torch.isfinite(value)
    return int(broken.sum())


def _shapes(config: TrainConfig, formations: Sequence[Formation]) -> dict[str, tuple[int, ...]]:
    """The shape of each parameter behind N, as training starts with it."""
    few = np.eye(4, 3, dtype=np.float32)
    start = Gaussians.from_points(
        few,
        np.zeros((4, 3), np.uint8),
        np.ones(4, np.float32),
        config=config.model,
        sh_degree=config.sh_degree,
        generator=torch.Generator(),
        formations=formations,
    )
    return {name: tuple(value.shape[1:]) for name, value in start.named_parameters()}
