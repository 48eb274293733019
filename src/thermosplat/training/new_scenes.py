"""Scenes that a training begins with: of a checkpoint or of the capture's points, on the device or offloaded."""

from dataclasses import replace

from thermosplat.config import OF_FRAMES, ModelConfig, ResolutionConfig, TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.distributed.team import Team
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.scene.model import SceneModel
from thermosplat.scene.offloaded import offload
from thermosplat.training.budget.teacher import may_teach
from thermosplat.training.offloading import Decision, decided, refused
from thermosplat.training.sharing.shares import keep_share

_FASTER = ("means_lr", "means_lr_final", "quats_lr", "scales_lr", "sh0_lr", "shN_lr")


def finds_cameras(config: TrainConfig) -> bool:
    """Whether passes come first that find the cameras of the other spectra."""
    return len(config.modelled) > 1 and not set(config.refine) <= OF_FRAMES and config.refine_first > 0


def of_passes(config: TrainConfig) -> TrainConfig:
    """What the scene on which cameras are found starts from, and how fast it learns.

    Its Gaussians are opaque and large enough to cover images from the first steps on, as 3DGS has it. A method's own
    start may cover them late, and through holes nothing is compared.
    """
    model = replace(config.model, init_opacity=ModelConfig().init_opacity)
    rates = {name: config.refine_rates * getattr(config.optimizer, name) for name in _FASTER}
    started = replace(config, model=model, resolution=ResolutionConfig())
    return replace(started, optimizer=replace(config.optimizer, **rates))


class NewScenes:
    """Makes the scenes of a training; what of them is offloaded is decided with the first one.

    Args:
        team: The ranks, of which each gets its share.
    """

    def __init__(self, config: TrainConfig, capture: Capture, team: Team) -> None:
        self._config, self._capture, self._team = config, capture, team
        self._decision: Decision | None = None

    @property
    def offloading(self) -> Decision:
        """What lies in the host's memory."""
        return Decision("nothing") if self._decision is None else self._decision

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user is told of that."""
        note = self.offloading.note
        return () if note is None else (note,)

    def first(self, checkpoint: Checkpoint | None) -> SceneModel:
        """The scene that a run begins or goes on with."""
        config = self._config
        return self.made(of_passes(config) if finds_cameras(config) else config, checkpoint)

    def made(self, start: TrainConfig, checkpoint: Checkpoint | None = None) -> SceneModel:
        """A scene on the device.

        Args:
            checkpoint: What it goes on from, of several ranks this one's share; None: the capture's points.

        Raises:
            UserError: Offloading is asked for where it does not work, or the checkpoint is damaged.
        """
        if checkpoint is None:
            model = SceneModel.from_capture(start, self._capture, "cpu")
        else:
            model = SceneModel.from_checkpoint(checkpoint, "cpu")
        if self._decision is None:
            self._decision = decided(self._config, model, self._team.device, divided=not self._team.is_alone)
        kind = self._decision.kind
        for name in model.gaussian_sets if kind != "nothing" else ():
            offload(model.gaussians(name), self._team.device, parameters=kind == "all")
        if checkpoint is None:
            keep_share(model, self._team)
        return model.to(self._team.device)

    @property
    def could_offload(self) -> bool:
        """Whether more could lie in the host's memory."""
        on_cuda, divided = self._team.device.type == "cuda", not self._team.is_alone
        return on_cuda and self.offloading.kind != "all" and refused(self._config, divided=divided) is None

    def may_teach(self, model: SceneModel) -> bool:
        """Whether there is room for scenes as they were: what is offloaded has none on the device.

        Ranks would have to render the scene of then together, too: they hold spectra by floors.
        """
        return self._team.is_alone and self.offloading.kind == "nothing" and may_teach(model)
