"""Splats that look like the exact render: fitted to it by its own images.

A model decodes the features of a pixel after blending; a splat has its colour before. The splats S that come nearest to
the exact images E minimise

    mean over cameras v and pixels of |R_v(S) - E_v|²

over all that a splat has: harmonics, opacity, centre, shape. Harmonics alone are not enough: a decoder makes sharp
edges of soft ones, and splats make them by being smaller, in other places. The exact render can be asked for any
camera, so the fit sees cameras between the training views, each of them once: nothing is learnt by heart, and no
photograph is looked at. The minimum is found by Adam with the renderer's own gradients.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.errors import UserError
from thermosplat.export.scene import Colors, spectrum_splats
from thermosplat.export.splat_fit.exact_images import ExactImages
from thermosplat.export.splat_fit.fit_steps import FitSteps
from thermosplat.export.splat_fit.learning_splats import LearningSplats
from thermosplat.export.splats import Splats
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.radiometry import PixelScale

PASSES = {"cpu": 30, "cuda": 60}
"""Passes by type of device where none are asked for."""
LAST_SHARE = 0.01
"""The step size at the end, of that at the start. It falls as half a wave of the cosine does: after 420 steps lab's
thermal splats are 43.3 dB from the exact render, and 42.2 dB where it falls exponentially."""
RELOCATE_AT = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
"""Shares of the steps at which faint splats move. At the start 62% of lab's thermal splats are invisible and 24% of
yard's: that they move brought 1.4 dB after 10 passes. Those that become faint while the others learn move, too."""
LEAST_INVISIBLE = 0.1
"""Share of the splats that is invisible at the start, from which on faint ones move. Of RGB splats about 3% are: where
they moved, yard's ended at 40.3 dB after ten passes, and at 42.0 dB where they did not."""
_SEED = 0


@dataclass(frozen=True)
class FittedSplats:
    """Splats, and how near they come to the exact render."""

    splats: Splats
    """The fitted splats; as they were, where no fit comes nearer."""
    sources: Tensor
    """Which Gaussian of the model each splat was made of, [N]: its own, unless it was faint and has moved."""
    before: float
    """PSNR against the exact render with each Gaussian's own decoded colour [dB], the mean over the measured views."""
    after: float
    """The same after the fit [dB]."""


def fit_splats(
    model: SceneModel,
    name: str,
    scale: PixelScale,
    views: Sequence[ViewTensors],
    *,
    sh_degree: int,
    measured: Sequence[ViewTensors] = (),
    colors: Colors = "palette",
    passes: int | None = None,
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> FittedSplats:
    """Splats of one spectrum that are fitted to the exact render.

    Args:
        views: Cameras of training, between which the fit takes place; distortions of lenses are left out.
        sh_degree: Highest SH degree in use, of the model and of the splats.
        measured: Cameras to measure in. None given: those of ``views``.
        colors: What the splats show (:data:`~thermosplat.export.scene.Colors`).
        passes: As many steps as this times the number of views, >= 1. None: ``PASSES`` of the device.
        progress: Wraps the loop over all steps, to show how far it is.

    Raises:
        UserError: There is no view to fit in, or the spectrum is not modelled.
    """
    if not views:
        raise UserError(
            f"The capture has no training views of {name} to fit the exported splats to.",
            "Export without: --fit-passes 0.",
        )
    unfitted = spectrum_splats(model, name, {name: scale}, colors=colors)
    exact = ExactImages(model, name, scale, sh_degree, colors)
    before = exact.mean_psnr(unfitted, measured or views)
    learning = LearningSplats(unfitted, views, sh_degree, error=10.0 ** (-before / 20.0))
    fit = FitSteps(learning, exact)
    steps = len(views) * (PASSES[unfitted.means.device.type] if passes is None else passes)
    between = ViewsBetween(views)
    generator = torch.Generator().manual_seed(_SEED)
    cameras: list[ViewTensors] = []
    moving = learning.invisible >= LEAST_INVISIBLE
    relocations = {int(share * steps) for share in RELOCATE_AT} - {0} if moving else set()
    for step in progress(range(steps)):
        if step in relocations:
            learning.relocate(exact, views, generator)
        cameras = cameras or between.draw(torch.randperm(len(views), generator=generator).tolist(), generator)
        share = LAST_SHARE + (1.0 - LAST_SHARE) * 0.5 * (1.0 + math.cos(math.pi * (step / steps)))
        fit.run(cameras.pop(), share)
    after = exact.mean_psnr(learning.detached(), measured or views)
    if after <= before:  # it was as good as the passes can make it
        return FittedSplats(unfitted, torch.arange(len(learning.sources)), before, before)
    return FittedSplats(learning.detached(), learning.sources, before, after)


class ViewsBetween:
    """Draws cameras at random places between views and their nearest neighbours.

    Args:
        views: The capture's, at least one.
        neighbors: How many neighbours to stay between; fewer where there are fewer views.
    """

    def __init__(self, views: Sequence[ViewTensors], neighbors: int = 3) -> None:
        self.views = views
        poses = torch.linalg.inv(torch.stack([view.viewmat for view in views]).double().cpu())  # camera to world
        self.rotations, self.centers = poses[:, :3, :3], poses[:, :3, 3]
        self.nearest = self._nearest(min(neighbors, len(views) - 1))

    def _nearest(self, count: int) -> Tensor:
        """Indices [V, 1 + count] of each view, itself first, then those nearest in place and viewing direction."""
        spread = (self.centers - self.centers.mean(dim=0)).square().sum(dim=1).mean().sqrt().clamp(min=1e-12)
        places = torch.cat([self.centers / spread, self.rotations[:, :, 2]], dim=1)  # the third axis looks forward
        distances = torch.cdist(places, places).fill_diagonal_(-1.0)  # where views coincide, each is its own first
        return distances.argsort(dim=1)[:, : 1 + count]

    def draw(self, indices: Sequence[int], generator: torch.Generator) -> list[ViewTensors]:
        """Cameras of the size and intrinsics of views, each between one view and its neighbours.

        Args:
            indices: The views, n of them.
            generator: Draws the weights of the poses, evenly among all that sum to one.

        Returns:
            n cameras.
        """
        chosen = self.nearest[list(indices)]
        weights = -torch.log(1.0 - torch.rand(chosen.shape, generator=generator, dtype=torch.float64))
        weights = weights / weights.sum(dim=1, keepdim=True)
        centers = torch.einsum("nk,nki->ni", weights, self.centers[chosen])
        u, _, vh = torch.linalg.svd(torch.einsum("nk,nkij->nij", weights, self.rotations[chosen]))
        u[:, :, 2] *= torch.linalg.det(u @ vh)[:, None]  # the nearest rotation is no reflection
        to_camera = (u @ vh).mT
        viewmats = torch.eye(4, dtype=torch.float64).repeat(len(chosen), 1, 1)
        viewmats[:, :3, :3] = to_camera
        viewmats[:, :3, 3] = -torch.einsum("nij,nj->ni", to_camera, centers)
        on_device = viewmats.to(self.views[0].viewmat).unbind()
        return [
            dataclasses.replace(self.views[index], viewmat=viewmat, image=None, intensity=None, values=None)
            for index, viewmat in zip(indices, on_device, strict=True)
        ]
