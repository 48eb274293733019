"""The stages of a training, in the order in which they act."""

from thermosplat.training.budget.tolerances import Tolerances
from thermosplat.training.session.safekeeping import Safekeeping
from thermosplat.training.session.training_parts import Training
from thermosplat.training.stages.budgets import BudgetStage
from thermosplat.training.stages.cameras import CameraStage
from thermosplat.training.stages.density import DensityStage
from thermosplat.training.stages.image_sizes import ImageSizes, StartingSpectra, SweptDepthsStage
from thermosplat.training.stages.noise import NoiseStage
from thermosplat.training.stages.scenes import Beginnings, SceneStage
from thermosplat.training.step_kind import Stage


def stages_of(
    training: Training,
    keeping: Safekeeping,
    beginnings: Beginnings,
    tolerances: Tolerances,
) -> tuple[Stage, ...]:
    """The stages that a training has."""
    config, state = training.config, training.state
    teaches = training.scenes.may_teach(state.model)
    stages: list[Stage] = []
    if config.resolution.factors:
        stages.append(ImageSizes(training))
    if state.preliminaries.find_cameras:
        stages.append(CameraStage(training, beginnings.start_anew))
    if any(spectrum.swept_depth > 0 for spectrum in config.modelled.values()):
        stages.append(SweptDepthsStage(training))
    stages.append(DensityStage(training))
    if config.budget == "auto":
        stages.append(BudgetStage(training, keeping, tolerances, teaches=teaches))
    if config.budget == "auto" or state.noise_watch is not None:
        stages.append(NoiseStage(training, teaches=teaches))
    if any(span.start > 0 for span in state.spans.values()):
        stages.append(StartingSpectra(training))
    if config.scenes > 1:
        stages.append(SceneStage(training, beginnings, keeping))
    return tuple(stages)
