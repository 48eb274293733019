"""A finished or interrupted run, read back for evaluation, rendering and export."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from thermosplat.checkpoint import damage_explained, load_checkpoint
from thermosplat.cli.warp_start import start_warp
from thermosplat.config import TrainConfig
from thermosplat.config_files import from_dict
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.devices import choose_device
from thermosplat.errors import UserError
from thermosplat.model import SceneModel
from thermosplat.radiometry import ThermalScale
from thermosplat.run_directory import RunDirectory, checkpoint_step
from thermosplat.training.resuming import other_frames


@dataclass(frozen=True)
class LoadedRun:
    """What a checkpoint holds, ready to render."""

    directory: RunDirectory
    """The result folder."""
    config: TrainConfig
    """The configuration it was trained with."""
    step: int
    """Training steps done."""
    sh_degree: int
    """Highest SH degree in use at that step."""
    model: SceneModel
    """The scene, on ``device``."""
    thermal_scale: ThermalScale | None
    """What thermal values mean; None without thermal images."""
    device: torch.device
    """Where the model is."""
    train_frames: list[str] | None
    """Names of the frames it was trained on; None where the checkpoint does not say."""
    test_frames: list[str] | None
    """Names of the frames it was to be judged by; None where the checkpoint does not say."""

    def capture(self, data: str | None) -> Capture:
        """The capture it was trained on.

        Args:
            data: Where it lies now; None: where it lay.

        Returns:
            The capture; a note of it says so if its frames are not those of the run.

        Raises:
            UserError: It cannot be read there.
        """
        if data is None and self.config.data != "sample" and not Path(self.config.data).exists():
            raise UserError(
                f"{self.directory.path} was trained on {self.config.data}, which is not there.",
                "Say where it lies now: --data FOLDER.",
            )
        config = self.config
        capture = load_capture(
            data or config.data, data_factor=config.data_factor, test_every=config.test_every, thermal=config.thermal
        )
        difference = other_frames(self.train_frames, capture)
        if not difference and not self.is_own(capture):
            difference = f"{capture.root} has other held-out frames."
        if difference:
            name = self.result_name(capture)
            note = f"Is this the capture of {self.directory.path}? {difference} Results are named {name}."
            capture = replace(capture, notes=(*capture.notes, note))
        return capture

    def is_own(self, capture: Capture) -> bool:
        """Whether a capture has the frames that the run was trained on and is judged by, as far as it says."""
        splits = ((self.train_frames, capture.train), (self.test_frames, capture.test))
        return all(then is None or then == [frame.name for frame in now] for then, now in splits)

    def result_name(self, capture: Capture) -> str:
        """What results on a capture are called: by the step; on another one than the run's, by its name too."""
        return f"{self.step:06d}" if self.is_own(capture) else f"{self.step:06d}_{capture.name}"


def load_run(folder: str, *, step: int | None = None, device: str = "auto") -> LoadedRun:
    """Read a run's checkpoint.

    Args:
        folder: The result folder.
        step: Which checkpoint. None: the one with the most steps.
        device: As ``--device``.

    Raises:
        UserError: No run, no such checkpoint, a damaged one, or no such device.
    """
    chosen = choose_device(device)
    directory = RunDirectory.open(folder)
    start_warp()
    state = load_checkpoint(_checkpoint(directory, step), chosen)
    scale = state["thermal_scale"]
    with damage_explained("thermal scale"):
        thermal_scale = None if scale is None else ThermalScale.from_state_dict(scale)
    return LoadedRun(
        directory=directory,
        config=from_dict(state["config"], source=f"the configuration stored in {folder}"),
        step=state["step"],
        sh_degree=state["sh_degree"],
        model=SceneModel.from_checkpoint(state, chosen).eval(),
        thermal_scale=thermal_scale,
        device=chosen,
        train_frames=state.get("train_frames"),
        test_frames=state.get("test_frames"),
    )


def _checkpoint(directory: RunDirectory, step: int | None) -> Path:
    latest = directory.latest_checkpoint()
    if latest is None:
        raise UserError(f"{directory.path} has no checkpoint yet.", "Train it: see config.yaml there for its settings.")
    if step is None:
        return latest
    path = directory.checkpoint(step)
    if not path.is_file():
        steps = [checkpoint_step(file) for file in directory.checkpoints()]
        raise UserError(
            f"{directory.path} has no checkpoint of step {step}.", f"It has: {', '.join(f'--step {n}' for n in steps)}."
        )
    return path
