"""What every rank has whole: gradients of it are summed, and what one rank has seen all know."""

from collections.abc import Sequence

import torch
from torch import Tensor

from thermosplat.distributed.team import Team
from thermosplat.training.training_state import TrainingState


def add_up_replicated(team: Team, state: TrainingState) -> None:
    """Sum the gradients of what every rank has whole, where some rank has one."""
    parameters = replicated_parameters(state)
    has = [int(parameter.grad is not None) for parameter in parameters]
    wanted = [any(of_all) for of_all in zip(*team.numbers(has), strict=True)] if has else []
    gradients = []
    for parameter, is_wanted in zip(parameters, wanted, strict=True):
        if is_wanted:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            gradients.append(parameter.grad)
    team.sum_in_place(gradients)


def tell_errors(team: Team, state: TrainingState, own: Sequence[Tensor]) -> None:
    """Let all ranks know the errors of the frames that this one trained on.

    Args:
        own: Indices of its frames, int64 scalars on the device.
    """
    watch = state.noise_watch
    if watch is None:
        return
    noted = torch.stack(list(watch.errors.values()))
    found = torch.zeros_like(noted)
    if own:
        index = torch.stack(list(own))
        found.index_copy_(1, index, noted.index_select(1, index))
    team.largest_in_place([found])  # a frame that two ranks have, where an epoch ends, has one error
    for errors, of_spectrum in zip(watch.errors.values(), found, strict=True):
        errors.copy_(torch.where(of_spectrum > 0, of_spectrum, errors))


def replicated_parameters(state: TrainingState) -> list[torch.nn.Parameter]:
    """What every rank has whole: decoders, exposures, and what is wrong with the cameras."""
    learnt = [
        parameter
        for owner, optimizers in state.optimizers.items()
        if owner not in state.gaussian_sets
        for optimizer in optimizers.values()
        for parameter in optimizer.param_groups[0]["params"]
    ]
    return learnt if state.exposures is None else [*learnt, *state.exposures.parameters()]
