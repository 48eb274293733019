"""Spectra that are trained from a later step on: their sets start as copies of others that are trained by then."""

from thermosplat.training.density.gaussian_ops import become_copy
from thermosplat.training.sharing.shares import count_anew
from thermosplat.training.stages.stage import Stage
from thermosplat.training.step_kind import StepKind


class StartingSpectra(Stage):
    """Sets that begin to be trained."""

    def acts_at(self, step: int) -> bool:
        """Where the training of something begins."""
        return any(step == span.start for span in self.training.state.spans.values())

    def after(self, step: int, kind: StepKind) -> None:
        """Make a spectrum's set a copy of another one's trained set, to be trained anew from it."""
        training, state = self.training, self.training.state
        for name, spectrum in training.config.modelled.items():
            if spectrum.start != "points" and step == state.spans[name].start:
                training.steps.forget()
                become_copy(state.gaussian_sets[name], state.optimizers[name], state.gaussian_sets[spectrum.start])
                state.strategies[name].forget(len(state.gaussian_sets[name]))
                count_anew(training.team, state)
