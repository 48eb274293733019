"""What a spectrum that has learnt noise is trained on: the scene as it was when withheld views were best.

Its renders have no noise that differs from view to view, so nothing is left in them that one view has alone: a spectrum
that is trained on them goes back to where it was best, within some hundred steps, while the images of others go on to
shape the Gaussians. (The scene is its own teacher, as in born-again networks: Furlanello et al. 2018, arXiv
1805.04770.)

The teacher renders the frame of each step anew, with the camera, the lens and the size that the step has. Kept images
would cost no time, but take as much memory as the capture, and fit neither cameras that are refined nor images that
grow.
"""

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.rasterizer.pair_capacity import CALLS
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.scene.model import SceneModel
from thermosplat.training.exposures import Exposures


class Teacher:
    """A scene that no training changes.

    Args:
        model: The scene; its parameters stay as they are now.
        sh_degree: Highest degree of its spherical harmonics that is used.
    """

    def __init__(self, model: SceneModel, sh_degree: int) -> None:
        self.model = model.requires_grad_(requires_grad=False)
        self.sh_degree = sh_degree

    @classmethod
    def of_now(cls, model: SceneModel, sh_degree: int) -> "Teacher":
        """A copy of a scene as it is now.

        Args:
            model: The scene, which goes on to be trained.
            sh_degree: As above.
        """
        return cls(copy.deepcopy(model), sh_degree)

    @torch.no_grad()
    def targets(self, name: str, frame: FrameTensors, exposures: Exposures | None) -> FrameTensors:
        """A training frame whose image of a spectrum is the teacher's; nothing here waits for the device.

        Args:
            name: The spectrum, of which the frame has a view.
            exposures: Of the training views; None: they have none. The teacher's image is as the training has them
                now, so that they are not learnt from it.
        """
        view = frame.views[name]
        rendered = self.model.render({name: view}, sh_degree=self.sh_degree, shared_cameras=[[name]])
        if exposures is not None and frame.index is not None:
            rendered = exposures(rendered, frame.index)
        taught = replace(view, image=rendered.images[name].clamp(0.0, 1.0))
        if view.intensity is not None:
            taught = replace(taught, intensity=self._intensity(name, rendered.features.get(name), view.intensity))
        return replace(frame, views={**frame.views, name: taught})

    def _intensity(self, name: str, features: Tensor | None, measured: Tensor) -> Tensor:
        """What the latent channels that stand for an intensity are compared with, [H, W]: those of the teacher."""
        first, beyond = self.model.spectra[name].latent
        if features is None or beyond - first != 1:
            return measured
        return features[..., first].clamp(0.0, 1.0)

    def state_dict(self) -> dict[str, Any]:
        """Tensors and built-in types."""
        saved = self.model.checkpoint_state()
        model = {"gaussian_sets": saved.gaussian_sets, "decoders": saved.decoders, "color_spaces": saved.color_spaces}
        return {"model": model, "sh_degree": self.sh_degree}

    @classmethod
    def from_state(cls, state: Mapping[str, Any], checkpoint: Checkpoint, device: torch.device) -> "Teacher":
        """The inverse of ``state_dict``.

        Args:
            state: Of another teacher.
            checkpoint: What it lay in: says what model it is.
            device: Where it is to be.

        Raises:
            KeyError: An entry is missing.
            UserError: It does not fit the model.
        """
        saved = replace(checkpoint, model=replace(checkpoint.model, **state["model"]))
        return cls(SceneModel.from_checkpoint(saved, device), int(state["sh_degree"]))


def may_teach(model: SceneModel) -> bool:
    """Whether a step has room for the renders of a teacher beside its own, in each spectrum."""
    return 2 * len(model.spectra) <= CALLS
