"""Every strategy that a configuration may name is there, and is one."""

import inspect
from typing import get_args, get_type_hints

import pytest

from thermosplat.config import DensificationConfig
from thermosplat.training.density.strategies import STRATEGIES
from thermosplat.training.density.strategy import Strategy

FLAGS = set(get_type_hints(Strategy))


def test_names_are_those_of_the_configuration() -> None:
    """No name is missing, none is more."""
    assert set(STRATEGIES) == set(get_args(get_type_hints(DensificationConfig)["strategy"]))


@pytest.mark.parametrize("name", STRATEGIES)
def test_strategies_keep_the_contract(name: str) -> None:
    """Each has every method of the protocol, with the same arguments, and every flag."""
    strategy = STRATEGIES[name](DensificationConfig(max_gaussians=9), 1.0, 5, "cpu", None, ("rgb", "thermal"))
    for method, expected in vars(Strategy).items():
        if inspect.isfunction(expected) and not method.startswith("_"):
            found = inspect.signature(getattr(type(strategy), method))
            assert list(found.parameters) == list(inspect.signature(expected).parameters), method
    assert {"separates_spectra", "moves_gaussians", "growing", "block", "most"} == FLAGS
    assert all(isinstance(getattr(strategy, flag), bool) for flag in FLAGS - {"block", "most"})
    assert strategy.most == 9  # as the configuration says
    assert strategy.block is None  # all Gaussians are here
    assert strategy.growing
    assert strategy.spectra == ("rgb", "thermal")  # type: ignore[attr-defined]


def test_what_strategies_ask_of_the_trainer() -> None:
    """Only decomposition needs spectra apart, only sampling moves Gaussians after every update."""
    made = {
        name: kind(DensificationConfig(max_gaussians=9), 1.0, 5, "cpu", None, ("rgb", "thermal"))
        for name, kind in STRATEGIES.items()
    }
    assert [name for name, strategy in made.items() if strategy.separates_spectra] == ["decomposing"]
    assert [name for name, strategy in made.items() if strategy.moves_gaussians] == ["mcmc"]
