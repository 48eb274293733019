"""The strategies of density control by the names that ``densification.strategy`` takes."""

from thermosplat.training.density.decomposition import DecomposingStrategy
from thermosplat.training.density.gradient_control import DefaultStrategy
from thermosplat.training.density.mcmc import McmcStrategy
from thermosplat.training.density.strategy import StrategyType

STRATEGIES: dict[str, StrategyType] = {
    "default": DefaultStrategy,
    "mcmc": McmcStrategy,
    "decomposing": DecomposingStrategy,
}
