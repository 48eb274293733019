"""Density control of a set that is divided over ranks: decided by rank 0, carried out by all.

A strategy looks at little of a Gaussian: its place, size and opacity, and sums of gradients. Rank 0 gathers that of all
Gaussians and lets the strategy work on it as in one process. What is large (colours, features, Adam's moments) is not
gathered: its place is taken by the number of the row, which the strategy copies and drops like any other parameter.
What comes out says for every Gaussian of afterwards which rows it is made of, and each rank fetches those of its block,
which leaves the ranks with equal numbers again.
"""

from typing import Any

import torch
from torch import Tensor, nn

from thermosplat.config import DensificationConfig
from thermosplat.distributed.team import RowFetch, Team, row_fetch
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.density.gaussian_ops import Optimizers, replace_parameters
from thermosplat.training.density.strategies import STRATEGIES
from thermosplat.training.sharing.shares import count_anew, step_counts
from thermosplat.training.training_state import TrainingState

SMALL = 4
"""Numbers per Gaussian of a parameter that rank 0 gathers: a quaternion's."""
_MOMENTS = ("exp_avg", "exp_avg_sq")


@torch.no_grad()
def refine(
    team: Team, state: TrainingState, name: str, config: DensificationConfig, step: int, generator: torch.Generator
) -> None:
    """Add and remove Gaussians of a set that may be divided, or reset opacities, as ``Strategy.refine``.

    Args:
        generator: Draws what is random, on the CPU.

    Raises:
        UserError: On rank 0, if no Gaussian is left.
    """
    gaussians, optimizers, strategy = state.gaussian_sets[name], state.optimizers[name], state.strategies[name]
    if team.is_alone:
        strategy.refine(gaussians, optimizers, step, generator)
        return
    counts = (state.counts or {})[name]
    stood_in = _StandIn(team, gaussians, optimizers, counts)
    sums = {key: _by_gaussian(value) for key, value in strategy.state_dict().items()}
    whole_sums = {key: team.on_first(value, counts) for key, value in sums.items()}
    after: dict[str, Tensor] = {}
    if team.is_first:
        spectra = tuple(spectrum for spectrum in state.model.spectra if state.model.set_of(spectrum) == name)
        make, extent, span = STRATEGIES[config.strategy], state.scene_extent, state.spans[name]
        whole = make(config, extent, sum(counts), team.device, span, spectra)
        whole.growing, whole.most = strategy.growing, strategy.most
        whole.load_state_dict({key: _as_kept(value) for key, value in whole_sums.items() if value is not None})
        whole.refine(stood_in.gaussians, stood_in.optimizers, step, generator)
        after = {key: _by_gaussian(value) for key, value in whole.state_dict().items()}
    total = team.object_of_first(len(stood_in.gaussians) if team.is_first else None)
    stood_in.carry_out(gaussians, optimizers, total)
    strategy.forget(len(gaussians))
    of_block = {key: team.from_first(after.get(key), sums[key], total) for key in sums}
    strategy.load_state_dict({key: _as_kept(value) for key, value in of_block.items()})
    count_anew(team, state)


def _by_gaussian(value: Tensor) -> Tensor:
    """What a strategy keeps, with Gaussians first: [N, ...] of [N, ...] or [S, N, ...]."""
    return value if value.dim() == 1 else value.transpose(0, 1).contiguous()


def _as_kept(value: Tensor) -> Tensor:
    """The inverse of ``_by_gaussian``."""
    return _by_gaussian(value)


class _StandIn:
    """On rank 0 all Gaussians of a set, large parameters and moments as numbers of rows; and what became of them."""

    def __init__(self, team: Team, gaussians: Gaussians, optimizers: Optimizers, counts: list[int]) -> None:
        self.team, self.counts = team, counts
        self.known = step_counts(optimizers)
        self.small = {
            name: value.detach()
            for name, value in gaussians.named_parameters()
            if 0 < value.shape[1:].numel() <= SMALL and name != "features"
        }
        gathered = {name: team.on_first(value, counts) for name, value in self.small.items()}
        if not team.is_first:
            return
        total = sum(counts)
        rows = torch.arange(total, dtype=torch.float64, device=team.device)
        parameters = {}
        for name, value in gaussians.named_parameters():
            whole = gathered.get(name)
            parameters[name] = rows if whole is None else whole.reshape(total, *value.shape[1:])
        self.gaussians = Gaussians(parameters)
        self.optimizers: Optimizers = {}
        for name, parameter in self.gaussians.named_parameters():
            self.optimizers[name] = torch.optim.Adam([parameter])
            if name in self.known:
                moments = {"step": self.known[name], "exp_avg": rows + 1.0}  # 0: they start anew
                self.optimizers[name].state[parameter] = moments

    def carry_out(self, gaussians: Gaussians, optimizers: Optimizers, total: int) -> None:
        """Let this rank's Gaussians and moments become its block of what rank 0 decided on."""
        whole = dict(self.gaussians.named_parameters()) if self.team.is_first else {}
        fetches = _Fetches(self.team, self.counts)
        replacements: dict[str, tuple[nn.Parameter, dict[str, Tensor]]] = {}
        number_like = torch.zeros(0, dtype=torch.float64, device=self.team.device)
        for name, parameter in gaussians.named_parameters():
            if name in self.small:
                values = self.team.from_first(whole.get(name), parameter.detach(), total)
            else:
                rows = self.team.from_first(whole.get(name), number_like, total)
                values = fetches.of(rows.long()).of(parameter.detach())
            moments: dict[str, Any] = dict(optimizers[name].state.get(parameter, {}))
            if name in self.known:
                held = self.optimizers[name].state[whole[name]]["exp_avg"] if self.team.is_first else None
                numbers = self.team.from_first(held, number_like, total).long()
                fetch, anew = fetches.of((numbers - 1).clamp(min=0)), numbers == 0
                for key in _MOMENTS:
                    moment = fetch.of(moments[key])
                    moment[anew] = 0.0
                    moments[key] = moment
            replacements[name] = nn.Parameter(values, requires_grad=parameter.requires_grad), moments
        replace_parameters(gaussians, optimizers, replacements)


class _Fetches:
    """Ways of rows, of which most parameters share one: made once for equal rows on all ranks."""

    def __init__(self, team: Team, counts: list[int]) -> None:
        self.team, self.counts = team, counts
        self._made: list[tuple[Tensor, RowFetch]] = []

    def of(self, rows: Tensor) -> RowFetch:
        """A way of these rows; every rank asks for the rows of one parameter at a time."""
        equal = [int(torch.equal(rows, known)) for known, _ in self._made]
        agreed = [min(of_all) for of_all in zip(*self.team.numbers([*equal, 1]), strict=True)]
        for (_, fetch), is_known in zip(self._made, agreed, strict=False):
            if is_known:
                return fetch
        fetch = row_fetch(self.team, self.counts, rows)
        self._made.append((rows, fetch))
        return fetch
