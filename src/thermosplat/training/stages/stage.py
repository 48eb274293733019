"""What every stage of a training may do."""

from thermosplat.config import OptimizerConfig
from thermosplat.training.session.training_parts import Training
from thermosplat.training.step_kind import StepKind


class Stage:
    """One thing that a training does from time to time: nothing, but for the methods that a stage has of its own.

    Args:
        training: What it works on.
    """

    def __init__(self, training: Training) -> None:
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
