"""``--budget auto`` between the steps of a run, on one rank or several.

What a budget does is rare, some ten times a run, and it measures images of the whole scene. On several ranks rank 0
does it with the whole model, then all take their shares of it. Rank 0 needs the memory of one process for it; the
others wait.
"""

from collections.abc import Callable

from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.scene.model import SceneModel
from thermosplat.training.budget.tolerances import Tolerances
from thermosplat.training.frames.train_frames import CorrectedFrames
from thermosplat.training.session.safekeeping import Safekeeping
from thermosplat.training.session.training_parts import Training
from thermosplat.training.sharing.shares import adopt, shares_of
from thermosplat.training.stages.auto_budget import AutoBudget
from thermosplat.training.step_kind import Stage, StepKind
from thermosplat.training.training_state import TrainingState


class BudgetStage(Stage):
    """A budget. While cameras are found it does nothing.

    Args:
        keeping: Gathers the whole model.
        tolerances: What may change.
        teaches: Whether spectra may be trained on what the scene showed when they were best.

    Attributes:
        plan: Of the scene under way. Says when something is due, from what all ranks know; does it where one has all.
    """

    def __init__(self, training: Training, keeping: Safekeeping, tolerances: Tolerances, *, teaches: bool) -> None:
        super().__init__(training)
        self._keeping, self._tolerances, self._teaches = keeping, tolerances, teaches
        self.plan: AutoBudget

    def _budget(self, state: TrainingState) -> AutoBudget:
        training = self.training
        return AutoBudget(
            training.config,
            state,
            CorrectedFrames(training.frames, state.corrections),
            training.schedule,
            noisy=bool(training.recipe.noisy),
            tolerances=self._tolerances,
            teaches=self._teaches,
            say=training.say,
        )

    def begin_scene(self) -> None:
        """Withhold the views that the scene withholds."""
        self.plan = self._budget(self.training.state)

    def acts_at(self, step: int) -> bool:
        """Where something may change."""
        return not self.training.state.preliminaries.find_cameras and self.plan.acts_at(step)

    def after(self, step: int, kind: StepKind) -> None:
        """Validate, stop growth or prune."""
        if self.plan.prunes_at(step):
            self.training.steps.forget(kernels=True)
        self._do(lambda budget: budget.after_step(step, kind.sh_degree))

    def leave(self) -> None:
        """Leave out what memory was too small for."""
        if self.training.state.budget.due:
            self._do(lambda budget: budget.do_what_is_due(self.training.sh_degree))

    def finish(self) -> None:
        """Drop what is not needed any more."""
        if not self.training.state.budget.trimmed:
            self._do(lambda budget: budget.finish(self.training.sh_degree))

    def _do(self, work: Callable[[AutoBudget], None]) -> None:
        training, team, state = self.training, self.training.team, self.training.state
        if team.is_alone:
            work(self.plan)
            return
        training.steps.forget()  # every rank gets its share anew
        whole = self._keeping.gathered(training=True)
        shares: list[Checkpoint] = []

        def act() -> None:
            if whole is None:
                return
            model = SceneModel.from_checkpoint(whole, team.device)
            everything = TrainingState(model, training.config, training.capture, team.device)
            everything.load(whole)
            work(self._budget(everything))
            after = self._keeping.checkpoint_of(everything)
            shares.extend(shares_of(after, team.size))

        team.asked_of_first(act)
        adopt(team, state, team.dealt(shares if team.is_first else None))
        if not self.plan.withholds():
            training.schedule.withhold(())
