"""Harmonics of splats that take up what the decoders add: least squares over views of the exact render.

A model decodes the features of a pixel after blending; a splat has its colour before. The colours c of all splats that
come nearest to the exact images E_v of the training views minimise

    Σ_v ‖R_v(c) - E_v‖²

where the render R_v is linear in the coefficients as far as no colour is clamped at 0. Positions, shapes and opacities
stay. The minimum is found by Adam with the renderer's own gradients, a view at a time in random order: preconditioned
by the size of each coefficient's gradients, as Gaussians differ by orders of magnitude in the pixels they fill.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.errors import UserError
from thermosplat.export.scene import Colors, decoded_features, shown_colors, spectrum_splats
from thermosplat.export.splat_rendering import render_splats
from thermosplat.export.splats import Splats
from thermosplat.image_quality.metrics import psnr
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.radiometry import PixelScale

SH0_RATE, SHN_RATE = 1.0, 0.2
"""Adam's step sizes at the start, of the images' root-mean-square error before the fit. On the sample, where that is
0.045 for RGB, a step of 0.05 for degree 0 ended 1 dB above one of 0.02 after six passes."""
LAST_SHARE = 0.01
"""The step size at the end, of that at the start; it falls exponentially."""
_SEED = 0


@dataclass(frozen=True)
class FittedSplats:
    """Splats, and how near they come to the exact render."""

    splats: Splats
    """The splats with fitted harmonics; as they were, where no fit comes nearer."""
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
    passes: int = 4,
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> FittedSplats:
    """Splats of one spectrum whose harmonics are fitted to the exact render.

    Args:
        model: The trained scene.
        name: The spectrum.
        scale: What its pixel values mean.
        views: Cameras to fit in, those of training; distortions of lenses are left out.
        sh_degree: Highest SH degree in use, of the model and of the splats.
        measured: Cameras to measure in. None given: those of ``views``.
        colors: What the splats show (:data:`~thermosplat.export.scene.Colors`).
        passes: How often each view is seen, >= 1.
        progress: Wraps the loop over all steps, to show how far it is.

    Raises:
        UserError: There is no view to fit in, or the spectrum is not modelled.
    """
    if not views:
        raise UserError(
            f"The capture has no training views of {name} to fit the exported colours to.",
            "Export without: --fit-passes 0.",
        )
    splats = spectrum_splats(model, name, {name: scale}, colors=colors)
    exact = _ExactImages(model, name, scale, sh_degree, colors)
    before = exact.mean_psnr(splats, measured or views)
    bases = (sh_degree + 1) ** 2 - 1
    sh0, shN = splats.sh0.clone().requires_grad_(), splats.shN[:, :bases].clone().requires_grad_()
    fitted = dataclasses.replace(splats, sh0=sh0, shN=shN)
    steps = passes * len(views)
    error = 10.0 ** (-before / 20.0)
    groups = [{"params": [sh0], "lr": SH0_RATE * error}, {"params": [shN], "lr": SHN_RATE * error}]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    schedule = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: LAST_SHARE ** (step / steps))
    images = [exact.image(view) for view in views]
    generator = torch.Generator().manual_seed(_SEED)
    orders = torch.cat([torch.randperm(len(views), generator=generator) for _ in range(passes)])
    for index in progress(orders.tolist()):
        adam.zero_grad()
        image = exact.render(fitted, views[index])
        wanted = images[index].to(image) / 255.0
        shown = torch.where(wanted == 1.0, image.clamp(max=1.0), image)  # brighter than white is white
        (shown - wanted).square().mean().backward()
        adam.step()
        schedule.step()
    fitted = dataclasses.replace(splats, sh0=sh0.detach(), shN=shN.detach())
    after = exact.mean_psnr(fitted, measured or views)
    if after <= before:  # it was as good as the passes can make it
        return FittedSplats(splats, before, before)
    return FittedSplats(fitted, before, after)


class _ExactImages:
    """What a model shows of one spectrum, and what splats show in its place."""

    def __init__(self, model: SceneModel, name: str, scale: PixelScale, sh_degree: int, colors: Colors) -> None:
        self.model, self.name, self.scale, self.sh_degree, self.colors = model, name, scale, sh_degree, colors
        self.background = self._background()

    @torch.no_grad()
    def _background(self) -> Tensor:
        """What the model shows where there are no Gaussians, [3]; splats shall not take it up."""
        model, name = self.model, self.name
        empty = torch.zeros(1, self.scale.channels, device=model.background.device)
        if model.decoders is not None and not model.decoder_config.covered_only:
            features = model.gaussians(model.set_of(name)).features
            empty = decoded_features(model, name, torch.zeros_like(features[:1]))
        if name == model.photograph and model.decoder_config.hybrid:
            empty = empty + model.background
        return shown_colors(empty[:, None].clamp(0, 1), self.scale, self.colors)[0, 0]

    @torch.no_grad()
    def image(self, view: ViewTensors) -> Tensor:
        """The exact image, 8-bit colours [H, W, 3] on the host; rounding leaves 59 dB."""
        pinhole = dataclasses.replace(view, distortion=None)
        exact = self.model.render({self.name: pinhole}, sh_degree=self.sh_degree).images[self.name].clamp(0, 1)
        return (shown_colors(exact, self.scale, self.colors) * 255.0).round().byte().cpu()

    def render(self, splats: Splats, view: ViewTensors) -> Tensor:
        """The splats' image, [H, W, 3]."""
        mode = self.model.config.rasterize_mode
        return render_splats(splats, view, rasterize_mode=mode, background=self.background)

    @torch.no_grad()
    def mean_psnr(self, splats: Splats, views: Sequence[ViewTensors]) -> float:
        """PSNR of the splats against the exact images [dB], the mean over the views."""
        total = 0.0
        for view in views:
            image = self.render(splats, view)
            total += psnr(image, self.image(view).to(image) / 255.0)
        return total / len(views) if views else math.nan
