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
from thermosplat.export.exact_images import ExactImages
from thermosplat.export.scene import Colors, spectrum_splats
from thermosplat.export.seen_harmonics import SeenHarmonics
from thermosplat.export.splat_relocation import errors_of_splats, moves, relocate
from thermosplat.export.splats import INVISIBLE_OPACITY, Splats
from thermosplat.export.views_between import ViewsBetween
from thermosplat.scene.model import SceneModel
from thermosplat.scene.rotation import rotate
from thermosplat.thermal.radiometry import PixelScale

PASSES = {"cpu": 30, "cuda": 60}
"""Passes by type of device where none are asked for."""
RATES = {"means": 0.2, "quats": 0.2, "log_scales": 0.4, "logit_opacities": 2.0, "color": 0.4, "changes": 0.05}
"""Adam's step sizes at the start, of the images' root-mean-square error before the fit: what is wrong by little is to
be moved by little. Those of the means also of the splat's own standard deviations, along its own axes. The colour is
that which all cameras see, the changes are those from camera to camera (``seen_harmonics``)."""
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
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> FittedSplats:
    """Splats of one spectrum that are fitted to the exact render.

    Args:
        model: The trained scene.
        name: The spectrum.
        scale: What its pixel values mean.
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
    fit = _Fit(unfitted, views, sh_degree, error=10.0 ** (-before / 20.0))
    steps = len(views) * (PASSES[unfitted.means.device.type] if passes is None else passes)
    schedule = torch.optim.lr_scheduler.LambdaLR(fit.adam, lambda step: _share_of_rate(step / steps))
    between = ViewsBetween(views)
    generator = torch.Generator().manual_seed(_SEED)
    order: list[int] = []
    relocations = {int(share * steps) for share in RELOCATE_AT} - {0} if fit.invisible >= LEAST_INVISIBLE else set()
    for step in progress(range(steps)):
        if step in relocations:
            fit.relocate(exact, views, generator)
        order = order or torch.randperm(len(views), generator=generator).tolist()
        view = between.draw(order.pop(), generator)
        fit.adam.zero_grad()
        image, wanted = exact.render(fit.splats, view), exact.image(view)
        shown = torch.where(wanted == 1.0, image.clamp(max=1.0), image)  # brighter than white is white
        (shown - wanted).square().mean().backward()
        fit.adam.step()
        schedule.step()
    after = exact.mean_psnr(fit.detached(), measured or views)
    if after <= before:  # it was as good as the passes can make it
        return FittedSplats(unfitted, torch.arange(len(fit.sources)), before, before)
    return FittedSplats(fit.detached(), fit.sources, before, after)


def _share_of_rate(done: float) -> float:
    """The step size of that at the start, where a share of the steps in [0, 1] is done."""
    return LAST_SHARE + (1.0 - LAST_SHARE) * 0.5 * (1.0 + math.cos(math.pi * done))


class _Fit:
    """Splats that learn, and their optimizer.

    A centre learns how many standard deviations it moves along the axes of its splat: a flat splat leaves its surface
    slowly, and small splats move less than large ones.

    Args:
        unfitted: As they are at the start.
        views: The cameras that see them.
        sh_degree: Highest degree to learn.
        error: Root-mean-square error of their images in [0, 1].
    """

    def __init__(self, unfitted: Splats, views: Sequence[ViewTensors], sh_degree: int, error: float) -> None:
        self.centers, self.quats = unfitted.means.clone(), unfitted.quats.clone()
        self.units = unfitted.log_scales.exp()
        self.harmonics = SeenHarmonics(unfitted.means, views, sh_degree)
        coefficients = torch.cat([unfitted.sh0, unfitted.shN], dim=1)[:, : (sh_degree + 1) ** 2]
        coordinates = self.harmonics.coordinates(coefficients)
        values = {
            "means": torch.zeros_like(unfitted.means),
            "quats": unfitted.quats.clone(),
            "log_scales": unfitted.log_scales.clone(),
            "logit_opacities": unfitted.logit_opacities.clone(),
            "color": coordinates[:, :1].clone(),
            "changes": coordinates[:, 1:].clone(),
        }
        self.learnt = {name: value.requires_grad_() for name, value in values.items()}
        self.sources = torch.arange(len(unfitted.means))
        self.invisible = (torch.sigmoid(unfitted.logit_opacities) < INVISIBLE_OPACITY).float().mean().item()
        groups = [{"params": [self.learnt[name]], "lr": rate * error} for name, rate in RATES.items()]
        fused = unfitted.means.device.type in ("cpu", "cuda")
        self.adam = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15, fused=fused)

    @property
    def splats(self) -> Splats:
        """The splats as they are now; gradients flow into all that learns."""
        learnt = self.learnt
        means = self.centers + rotate(self.quats, self.units * learnt["means"])
        coefficients = self.harmonics.coefficients(torch.cat([learnt["color"], learnt["changes"]], dim=1))
        shape = learnt["quats"], learnt["log_scales"], learnt["logit_opacities"]
        return Splats(means, *shape, coefficients[:, :1], coefficients[:, 1:])

    @torch.no_grad()
    def detached(self) -> Splats:
        """A copy of the splats as they are now, without gradients."""
        splats = self.splats
        return Splats(**{field.name: getattr(splats, field.name).clone() for field in dataclasses.fields(Splats)})

    def relocate(self, exact: ExactImages, views: Sequence[ViewTensors], generator: torch.Generator) -> None:
        """Move faint splats; what has changed starts again with moments of zero."""
        splats = self.detached()
        moved, onto = moves(errors_of_splats(splats, exact, views), splats.logit_opacities, generator)
        relocate(splats, moved, onto)
        self.sources[moved.cpu()] = self.sources[onto.cpu()]
        changed = torch.cat([moved, onto])
        with torch.no_grad():
            self.centers[changed] = splats.means[changed]
            self.quats[changed] = splats.quats[changed]
            self.units[changed] = splats.log_scales[changed].exp()
            self.harmonics.from_coordinates[moved] = self.harmonics.from_coordinates[onto]
            learnt = self.learnt
            learnt["means"][changed] = 0.0
            for name in ("quats", "log_scales", "logit_opacities"):
                learnt[name][changed] = getattr(splats, name)[changed]
            for name in ("color", "changes"):
                learnt[name][moved] = learnt[name][onto]
        for state in self.adam.state.values():
            for moment in (state["exp_avg"], state["exp_avg_sq"]):
                moment[changed] = 0.0
