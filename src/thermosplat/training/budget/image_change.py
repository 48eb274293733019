"""By how much training images change when the model does, and the most that may be left out of it within a tolerance.

The change of a spectrum's images is measured against their error: the mean squared difference to the renders from
before, divided by the mean squared difference of those to the ground truth. Where the two are independent, a change of
x costs 10 log10(1 + x) dB of the images' PSNR: 0.04 dB for 0.01. So what is noise in a capture sets the scale, in each
spectrum by itself, and nothing needs a threshold in units of its own.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.evaluation.training_views import LEARNT, one_color_error
from thermosplat.image_quality.metrics import right_outside
from thermosplat.losses.image_terms import image_terms
from thermosplat.scene.model import SceneModel


class ImageChange:
    """The images of a model as it is now, to compare later ones with.

    Args:
        frames: The frames to look at; their renders are kept on the device.
        losses: With it the channels that its losses compare with images count as images too.
    """

    def __init__(
        self, model: SceneModel, frames: Sequence[FrameTensors], sh_degree: int, losses: TrainConfig | None = None
    ) -> None:
        self.model = model
        self.frames = frames
        self.sh_degree = sh_degree
        self.losses = losses
        self._before: list[dict[str, Tensor]] = []
        errors: dict[str, list[Tensor]] = {}
        targets: dict[str, list[Tensor]] = {}
        for frame in frames:
            compared = self._compared(frame)
            self._before.append({name: image for name, (image, _) in compared.items()})
            for name, (image, target) in compared.items():
                errors.setdefault(name, []).append((image - target).square().mean())
                if name in model.spectra:
                    targets.setdefault(name, []).append(target)
        self.errors = {name: max(_mean(found), 1e-12) for name, found in errors.items()}
        """Mean squared error of the images from before, by name of what has ground truth: a spectrum, and by the loss's
        name the channels that it looks at."""
        least = 10 ** (-LEARNT / 10)
        self.not_learnt = tuple(
            name for name, found in targets.items() if self.errors[name] > least * one_color_error(found)
        )
        """The spectra whose images are little nearer to the ground truth than one colour is: their error is no measure
        of what the model may lose."""

    def now(self) -> float:
        """Squared change of the images since then, as a share of their squared error; the largest of all."""
        changes: dict[str, list[Tensor]] = {name: [] for name in self.errors}
        for frame, before in zip(self.frames, self._before, strict=True):
            for name, (image, _) in self._compared(frame).items():
                changes[name].append((image - before[name]).square().mean())
        return max((_mean(found) / self.errors[name] for name, found in changes.items()), default=0.0)

    @torch.no_grad()
    def _compared(self, frame: FrameTensors) -> dict[str, tuple[Tensor, Tensor]]:
        """What the model renders of a frame, clamped to [0, 1], and its ground truth, by name of what has one."""
        rendered = self.model.render(frame.views, sh_degree=self.sh_degree, shared_cameras=frame.shared_cameras)
        compared = {}
        for name in rendered.images:
            view, formation = frame.views[name], rendered.formations[name]
            if view.image is not None:
                target = formation.graded_truth(view.image)
                compared[name] = (right_outside(formation.graded(rendered), target, view.mask), target)
        if self.losses is not None:
            compared |= {term.name: (term.render, term.target) for term in image_terms(rendered, frame, self.losses)}
        return {name: (image.clamp(0.0, 1.0), target) for name, (image, target) in compared.items()}


def most_within(change: ImageChange, most: int, apply: Callable[[int], None], tolerance: float) -> int:
    """The largest number of reductions whose change of the images stays within the tolerance, by bisection.

    Args:
        change: The images from before.
        most: The largest number there can be, >= 0.
        apply: Makes the model one with so many reductions, whatever it was made before.
        tolerance: Largest change.

    Returns:
        The number, to a thousandth of ``most``; the model is left with so many reductions.
    """
    within, beyond = 0, most + 1
    while beyond - within > max(1, most // 1000):
        middle = (within + beyond) // 2
        apply(middle)
        if change.now() <= tolerance:
            within = middle
        else:
            beyond = middle
    apply(within)
    return within


def _mean(values: list[Tensor]) -> float:
    return torch.stack(values).double().mean().item()
