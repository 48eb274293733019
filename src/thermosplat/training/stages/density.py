"""Gaussians that are added, removed and moved between steps, as many as the images have room for."""

from dataclasses import replace

from thermosplat.training.frames.random_streams import random_stream
from thermosplat.training.frames.resolution_schedule import most_gaussians
from thermosplat.training.sharing.refining import refine
from thermosplat.training.step_kind import Stage, StepKind


class DensityStage(Stage):
    """Density control of every set. The scene on which cameras are found keeps its Gaussians: many small ones fit
    images through wrong cameras."""

    def before(self, step: int, kind: StepKind) -> StepKind:
        """Note gradients for the next refinement."""
        state = self.training.state
        is_active = any(strategy.is_active(step) for strategy in state.strategies.values())
        if state.preliminaries.camera_passes or not is_active:
            return kind
        return replace(kind, densifying=True)

    def acts_at(self, step: int) -> bool:
        """Where a strategy refines or resets."""
        state = self.training.state
        return not state.preliminaries.camera_passes and any(
            strategy.refines_at(step) or strategy.resets_at(step) for strategy in state.strategies.values()
        )

    def after(self, step: int, kind: StepKind) -> None:
        """Refine the sets whose turn it is; ranks divide all rows anew, also where one would change them in place."""
        training, state = self.training, self.training.state
        due = {n: s for n, s in state.strategies.items() if s.refines_at(step) or s.resets_at(step)}
        if not training.team.is_alone or any(s.replaces_tensors(state.gaussian_sets[n]) for n, s in due.items()):
            training.steps.forget()
        for name, strategy in due.items():
            strategy.most = most_gaussians(training.config, kind.image_factor)
            random = random_stream(state.preliminaries.seed, "split", step)
            refine(training.team, state, name, training.config.densification, step, random)
