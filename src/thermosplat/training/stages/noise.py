"""Noise that is not to be learnt: how far views are fitted, and spectra that are taught by the scene of before."""

from dataclasses import replace

from thermosplat.training.budget.noise_watch import NoiseWatch
from thermosplat.training.session.training_parts import Training
from thermosplat.training.step_kind import Stage, StepKind


class NoiseStage(Stage):
    """The watch over noisy images (budget/noise_watch.py).

    Args:
        teaches: Whether there is room for scenes as they were.
    """

    def __init__(self, training: Training, *, teaches: bool) -> None:
        super().__init__(training)
        state, floors = training.state, training.recipe.floors
        if state.noise_watch is not None:
            if not teaches:
                state.noise_watch.forget_teachers()
            state.noise_watch.measured_anew(floors)
        elif floors:
            state.noise_watch = NoiseWatch(floors, len(training.frames), training.team.device)
            if not state.budget.growing:
                state.noise_watch.end()

    def before(self, step: int, kind: StepKind) -> StepKind:
        """Compare taught spectra with what their teachers show."""
        taught = self.training.state.taught
        return replace(kind, taught=taught) if taught else kind
