"""What the host decides about a step before the device does it, what stages have to say, and what the step says."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from thermosplat.config import OptimizerConfig, TrainConfig
from thermosplat.training.exposures import FROM as EXPOSED_FROM

if TYPE_CHECKING:
    from thermosplat.training.session.training_parts import Training

DEPTH_SPREAD_FROM = 0.5
"""Share of the steps before the spread of depths along rays counts. Open choice."""
Group = tuple[str, ...]
"""Spectra that one camera renders, in the model's order."""


@dataclass(frozen=True)
class StepValues:
    """What a step says of itself, on the device; of a captured step, until the next one overwrites it."""

    losses: dict[str, Tensor]
    """Weighted loss terms by name."""
    squared_errors: dict[str, Tensor]
    """Mean squared error of the step's own images, clamped to [0, 1], by spectrum."""


@dataclass(frozen=True)
class StepKind:
    """What the host decides about a step, beside the frame."""

    sh_degree: int
    """Degree of the spherical harmonics in use."""
    densifying: bool = False
    depth_spread: bool = False
    """Let the spread of depths along rays be a loss."""
    swept_depths: bool = False
    """Let depths be drawn to those that plane sweeps found."""
    refining: bool = False
    exposing: bool = False
    """Let the exposures of the frame follow its images."""
    geometry_held: bool = False
    """Let the images of the first spectrum alone shape the Gaussians, and leave opacity offsets at zero."""
    image_factor: float = 1.0
    """What the sides of the images are divided by."""
    taught: tuple[str, ...] = ()
    """Spectra that are compared with what a teacher shows, in place of images."""

    @classmethod
    def at(cls, config: TrainConfig, step: int) -> "StepKind":
        """What a configuration says of a step, before the stages of a training have their say.

        Args:
            step: The step, from 1.
        """
        return cls(
            sh_degree_at(config, step),
            depth_spread=config.loss.depth_spread > 0 and step > DEPTH_SPREAD_FROM * config.max_steps,
            refining=bool(config.refine) and step > config.refine_from,
            exposing=step > EXPOSED_FROM * config.max_steps,
        )


@dataclass(frozen=True)
class Plan:
    """The frames of a step, which every rank knows of all of them."""

    penalised: tuple[str, ...]
    """The sets of Gaussians whose own penalties come with the step."""
    rounds: tuple[tuple[tuple[Group, ...], ...], ...]
    """The groups of spectra of every frame, as many frames at a time as there are ranks."""

    @property
    def frames(self) -> int:
        """Of all ranks."""
        return sum(map(len, self.rounds))


def sh_degree_at(config: TrainConfig, step: int) -> int:
    """Degree of the spherical harmonics in a step: one more every ``sh_degree_interval`` steps. 3DGS."""
    return min(int(max(step - 1, 0) // config.sh_degree_interval), config.sh_degree)


class Stage:
    """One thing that a training does from time to time: nothing, but for the methods that a stage has of its own."""

    def __init__(self, training: "Training") -> None:
        self.training = training

    def begin_scene(self) -> None:
        """Get ready for a scene that starts, or goes on."""

    def before(self, step: int, kind: StepKind) -> StepKind:
        """What is done in a step to come, of what the configuration and the stages before this one make of it."""
        return kind

    def rates(self, rates: OptimizerConfig) -> OptimizerConfig:
        """The rates of a step to come, of those of the stages before this one."""
        return rates

    def acts_at(self, step: int) -> bool:
        """Whether something is done after this step: then the device is waited for, and a bad state goes no further."""
        return False

    def after(self, step: int, kind: StepKind) -> None:
        """Do what belongs to the step done, in which no interrupt is heard; where ``acts_at`` says so."""

    def leave(self) -> None:
        """Go on to what follows the step done, where it was a last one. An interrupt leaves the state as it was."""

    def finish(self) -> None:
        """Do what comes after the last step."""

    def notes(self) -> tuple[str, ...]:
        """What the user is told at the beginning."""
        return ()
