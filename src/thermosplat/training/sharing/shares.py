"""A training state divided over ranks, and made whole again as the checkpoint of one process.

The ranks together hold the Gaussians in the order in which one process has them: rank 0 the first block, and so on
(``team.blocks``). So a checkpoint is the same file whatever number of ranks wrote it.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from thermosplat.distributed.team import Team, blocks
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.runs.checkpoint_file import on_host
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.scene.packed_parameters import pack
from thermosplat.training.budget.progress import BudgetProgress
from thermosplat.training.density.gaussian_ops import replace_parameters
from thermosplat.training.optimizers import load_optimizer
from thermosplat.training.training_state import TrainingState

_SECOND_DIMENSION = ("gradient_sums",)
"""What density control keeps by Gaussian in the second dimension; anything else in the first."""

_NO_TEACHERS: dict[str, Any] = {"teachers": {}, "best_teachers": {}}
"""Of what ranks hold noisy spectra by: whole scenes would have to be rendered by all ranks together."""


def keep_share(model: SceneModel, team: Team) -> None:
    """Leave a whole model this rank's share of the Gaussians."""
    for name in model.gaussian_sets if team.size > 1 else ():
        gaussians = model.gaussians(name)
        block = team.block_of(len(gaussians))
        model.gaussian_sets[name] = _gaussians_like(
            gaussians, {key: value.detach()[block] for key, value in gaussians.named_parameters()}
        )


def count_anew(team: Team, state: TrainingState) -> None:
    """Let this rank know how many Gaussians the others have, and density control which of all are its own.

    Args:
        team: The ranks; one alone has all.
    """
    if team.is_alone:
        return
    state.counts = {}
    for name, gaussians in state.gaussian_sets.items():
        counts = state.counts[name] = [held for (held,) in team.numbers([len(gaussians)])]
        state.strategies[name].block = (sum(counts[: team.rank]), sum(counts))


def divided_sets(sets: Mapping[str, Gaussians], ranks: int) -> list[dict[str, Gaussians]]:
    """Each rank's share of the Gaussians of all sets."""
    shares: list[dict[str, Gaussians]] = [{} for _ in range(ranks)]
    for name, gaussians in sets.items():
        parameters, rows = dict(gaussians.named_parameters()), blocks(len(gaussians), ranks)
        cut = {key: value.detach().split(rows) for key, value in parameters.items()}
        for rank, share in enumerate(shares):
            share[name] = _gaussians_like(gaussians, {key: parts[rank] for key, parts in cut.items()})
    return shares


def shares_of(checkpoint: Checkpoint, ranks: int) -> list[Checkpoint]:
    """What each rank goes on from, of a whole checkpoint."""
    model = SceneModel.from_checkpoint(checkpoint, "cpu")
    shares, starts = [], dict.fromkeys(model.gaussian_sets, 0)
    sets = {name: model.gaussians(name) for name in model.gaussian_sets}
    for rank in range(ranks):
        stops = {name: starts[name] + blocks(len(gaussians), ranks)[rank] for name, gaussians in sets.items()}
        cut = {name: slice(starts[name], stops[name]) for name in sets}
        share = _share(checkpoint, sets, cut)
        if rank > 0:  # rank 0 keeps whole scenes, and the others their places
            places: tuple[dict[str, Any], ...] = tuple({} for _ in share.training.kept_scenes)
            share = replace(share, training=replace(share.training, kept_scenes=places))
        shares.append(share)
        starts = stops
    return shares


def _share(checkpoint: Checkpoint, sets: Mapping[str, Gaussians], cut: Mapping[str, slice]) -> Checkpoint:
    def rows(value: Any, name: str, dimension: int = 0) -> Any:
        if not isinstance(value, Tensor) or value.dim() <= dimension:
            return value
        part = value[cut[name]] if dimension == 0 else value[:, cut[name]]
        return part.to("cpu", copy=True)  # a view would bring all of its memory along

    training = checkpoint.training
    optimizers = training.optimizers
    if optimizers is not None:
        optimizers = {
            owner: {
                key: _with_moments(state, lambda moment, owner=owner: rows(moment, owner)) if owner in cut else state
                for key, state in states.items()
            }
            for owner, states in optimizers.items()
        }
    strategies = {
        name: {key: rows(value, name, int(key in _SECOND_DIMENSION)) for key, value in state.items()}
        for name, state in (training.strategies or {}).items()
    }
    gaussian_sets = {}
    for name, gaussians in sets.items():
        gaussian_sets[name] = {key: rows(value.detach(), name) for key, value in gaussians.named_parameters()}
        if gaussians.feature_basis is not None:
            gaussian_sets[name]["feature_basis"] = gaussians.feature_basis
    return replace(
        checkpoint,
        model=replace(checkpoint.model, gaussian_sets=gaussian_sets, decoders=on_host(checkpoint.model.decoders)),
        training=replace(
            training,
            optimizers=on_host(optimizers),
            strategies=strategies,
            exposures=on_host(training.exposures),
            corrections=on_host(training.corrections),
            noise_watch=None if training.noise_watch is None else training.noise_watch | _NO_TEACHERS,
        ),
    )


def whole_checkpoint(team: Team, state: TrainingState, own: Checkpoint, *, training: bool = True) -> Checkpoint | None:
    """The checkpoint of all ranks together, in rank 0's host memory; None on the other ranks.

    Args:
        own: This rank's checkpoint (``TrainingState.checkpoint``).
    """
    if team.is_alone:
        return own
    counts = state.counts or {}
    gaussian_sets: dict[str, dict[str, Tensor]] = {}
    for name, gaussians in state.gaussian_sets.items():
        gathered = {key: _whole(team, value.detach(), counts[name]) for key, value in gaussians.named_parameters()}
        if gaussians.feature_basis is not None:
            gathered["feature_basis"] = gaussians.feature_basis.cpu()
        if team.is_first:
            gaussian_sets[name] = pack({key: value for key, value in gathered.items() if value is not None})
    whole = own.training
    if training and whole.optimizers is not None:
        whole = replace(
            whole,
            optimizers={
                owner: {
                    key: _with_moments(saved, lambda moment, owner=owner: _whole(team, moment, counts[owner]))
                    if owner in state.gaussian_sets
                    else saved
                    for key, saved in states.items()
                }
                for owner, states in whole.optimizers.items()
            },
        )
    if not training:
        whole = replace(whole, optimizers=None)
    strategies = {}
    for name, held in (whole.strategies or {}).items():
        strategies[name] = {key: _whole_sums(team, key, value, counts[name]) for key, value in held.items()}
    whole = replace(whole, strategies=strategies)
    if not team.is_first:
        return None
    return replace(own, model=replace(own.model, gaussian_sets=gaussian_sets), training=whole)


def adopt(team: Team, state: TrainingState, checkpoint: Checkpoint) -> None:
    """Go on from a checkpoint of the same step with other Gaussians, in place."""
    device = state.step_on_device.device
    model = SceneModel.from_checkpoint(checkpoint, device)
    saved = checkpoint.training.optimizers or {}
    for name, gaussians in state.gaussian_sets.items():
        found = model.gaussians(name)
        optimizers = state.optimizers[name]
        replace_parameters(gaussians, optimizers, {key: (value, {}) for key, value in found.named_parameters()})
        gaussians.feature_basis = found.feature_basis
        for key, optimizer in optimizers.items():
            if name in saved:
                load_optimizer(optimizer, saved[name][key])
        state.strategies[name].forget(len(gaussians))
        state.strategies[name].load_state_dict((checkpoint.training.strategies or {})[name])
    state.model.formations.load_state_dict(model.formations.state_dict())
    training = checkpoint.training
    state.budget = BudgetProgress.of_checkpoint(training)
    if training.noise_watch is not None and state.noise_watch is not None:
        state.noise_watch.load_state_dict(training.noise_watch)
    for strategy in state.strategies.values():
        strategy.growing = training.growing
    count_anew(team, state)


def _gaussians_like(gaussians: Gaussians, parameters: dict[str, Tensor]) -> Gaussians:
    basis = {} if gaussians.feature_basis is None else {"feature_basis": gaussians.feature_basis}
    return Gaussians({**parameters, **basis})


def _whole(team: Team, rows: Tensor, counts: list[int]) -> Tensor | None:
    everything = team.on_first(rows, counts)
    return None if everything is None else everything.cpu()


def _whole_sums(team: Team, key: str, value: Tensor, counts: list[int]) -> Tensor | None:
    """What density control keeps, of all Gaussians."""
    if key not in _SECOND_DIMENSION:
        return _whole(team, value, counts)
    everything = _whole(team, value.transpose(0, 1).contiguous(), counts)
    return None if everything is None else everything.transpose(0, 1).contiguous()


def _with_moments(saved: dict[str, Any], changed: Any) -> dict[str, Any]:
    """An optimizer's ``state_dict`` with its moments, one row for each Gaussian, changed."""
    states = {
        number: {key: value if key == "step" else changed(value) for key, value in moments.items()}
        for number, moments in saved["state"].items()
    }
    return {**saved, "state": states}


def step_counts(optimizers: Mapping[str, torch.optim.Adam]) -> dict[str, Tensor]:
    """Updates that Adam has made, by parameter name; of those it knows."""
    found = {}
    for name, optimizer in optimizers.items():
        state = optimizer.state.get(optimizer.param_groups[0]["params"][0], {})
        if state:
            found[name] = state["step"]
    return found
