"""``--budget auto`` of a run on several ranks: rank 0 does it with the whole model, then all take their shares of it.

What a budget does is rare, some ten times a run, and it measures images of the whole scene. Rank 0 needs the memory of
one process for it; the others wait.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.scene.model import SceneModel
from thermosplat.training.budget.auto_budget import AutoBudget
from thermosplat.training.frames.train_frames import CorrectedFrames
from thermosplat.training.sharing.shares import adopt, shares_of
from thermosplat.training.training_state import TrainingState

if TYPE_CHECKING:
    from thermosplat.training.sharing.divided_trainer import DividedTrainer


class DividedBudget:
    """A ``Budget`` for ranks; every method is to be called by all.

    Args:
        trainer: One rank's trainer.
    """

    def __init__(self, trainer: "DividedTrainer") -> None:
        self.trainer = trainer
        # says when something is due, from what all ranks know; it never looks at this rank's Gaussians alone
        self._how: dict[str, Any] = {"tolerances": trainer.tolerances, "teaches": False}
        frames = CorrectedFrames(trainer.frames, trainer.state.corrections)
        self.plan = AutoBudget(trainer.config, trainer.state, frames, trainer.schedule, **self._how)

    def acts_at(self, step: int) -> bool:
        """As ``AutoBudget``'s."""
        return self.plan.acts_at(step)

    def prunes_at(self, step: int) -> bool:
        """As ``AutoBudget``'s."""
        return self.plan.prunes_at(step)

    def after_step(self, step: int, sh_degree: int) -> None:
        """As ``AutoBudget``'s."""
        self._done_whole(lambda budget: budget.after_step(step, sh_degree))

    def do_what_is_due(self, sh_degree: int) -> None:
        """As ``AutoBudget``'s."""
        if self.trainer.state.budget_due:
            self._done_whole(lambda budget: budget.do_what_is_due(sh_degree))

    def finish(self, sh_degree: int) -> None:
        """As ``AutoBudget``'s."""
        if not self.trainer.state.trimmed:
            self._done_whole(lambda budget: budget.finish(sh_degree))

    def _done_whole(self, work: Callable[[AutoBudget], None]) -> None:
        trainer = self.trainer
        team, state, device = trainer.team, trainer.state, trainer.device
        trainer.steps.forget()  # every rank gets its share anew
        whole = trainer.gathered(training=True)
        shares: list[Checkpoint] = []

        def act() -> None:
            if whole is None:
                return
            model = SceneModel.from_checkpoint(whole, device)
            everything = TrainingState(model, trainer.config, trainer.capture, device)
            everything.load(whole)
            frames = CorrectedFrames(trainer.frames, everything.corrections)
            say = trainer.logger.say
            work(AutoBudget(trainer.config, everything, frames, trainer.schedule, **self._how, say=say))
            after = everything.checkpoint(trainer.asked, trainer.sh_degree, trainer.capture.scales, trainer.capture)
            shares.extend(shares_of(after, team.size))

        team.asked_of_first(act)
        adopt(team, state, team.dealt(shares if team.is_first else None))
        trainer.tell_blocks()
        if not self.plan.withholds():
            trainer.schedule.withhold(())
