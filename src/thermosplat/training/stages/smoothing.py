"""When the 3D smoothing filter follows the Gaussians: ``model.filter_3d``."""

from thermosplat.scene.smoothing_filter import sampling_cameras, set_filter, store_filtered
from thermosplat.training.session.training_parts import Training
from thermosplat.training.step_kind import Stage, StepKind

EVERY = 100
"""Steps after which filters are computed anew. Mip-Splatting."""


class SmoothingStage(Stage):
    """A filter for each set, computed anew now and then and where Gaussians were added or removed.

    At the end it becomes part of scales and opacities, before a budget looks at what else can go. Checkpoints on the
    way hold Gaussians without it, from which a training goes on. It is of one process: ranks do not tell each other of
    filters.
    """

    def __init__(self, training: Training) -> None:
        super().__init__(training)
        self._cameras = sampling_cameras(training.capture, training.state.model.sets_of_spectra)
        self._numbers: dict[str, int] = {}

    def begin_scene(self) -> None:
        """Compute the filters of a scene that is to be trained."""
        if self.training.state.step < self.training.config.max_steps:
            self._set_filters()

    def before(self, step: int, kind: StepKind) -> StepKind:
        """Compute filters anew where that is due."""
        if step % EVERY == 0 or self._numbers != self._numbers_now():
            self._set_filters()
        return kind

    def finish(self) -> None:
        """Store what the filters make of the Gaussians."""
        for gaussians in self.training.state.gaussian_sets.values():
            store_filtered(gaussians)

    def _set_filters(self) -> None:
        for name, gaussians in self.training.state.gaussian_sets.items():
            set_filter(gaussians, self._cameras[name])
        self._numbers = self._numbers_now()

    def _numbers_now(self) -> dict[str, int]:
        return {name: len(gaussians) for name, gaussians in self.training.state.gaussian_sets.items()}
