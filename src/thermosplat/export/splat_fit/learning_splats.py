"""Splats that learn, and their optimizer.

A centre learns how many standard deviations it moves along the axes of its splat: a flat splat leaves its surface
slowly, and small splats move less than large ones. A colour learns in coordinates that the cameras can tell apart
(``seen_harmonics``).
"""

import dataclasses
from collections.abc import Sequence

import torch

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.splat_fit.exact_images import ExactImages
from thermosplat.export.splat_fit.seen_harmonics import SeenHarmonics
from thermosplat.export.splat_fit.splat_relocation import errors_of_splats, moves, relocate
from thermosplat.export.splats import INVISIBLE_OPACITY, Splats
from thermosplat.fused.adam import WarpAdam
from thermosplat.scene.rotation import rotate

RATES = {"means": 0.2, "quats": 0.2, "log_scales": 0.4, "logit_opacities": 2.0, "colors": 0.4}
"""Adam's step sizes at the start, of the images' root-mean-square error before the fit: what is wrong by little is to
be moved by little. Those of the means also of the splat's own standard deviations, along its own axes. Those of the
colours are of the colour that all cameras see (``seen_harmonics``)."""
BETAS = (0.9, 0.99)
"""Adam's decays of its moments. Splats that have moved start with moments of zero; with 0.999 for the second, their
first steps would be three times as long. Lab's thermal splats ended 0.4 dB nearer than with 0.999, yard's RGB alike."""


class LearningSplats:
    """Splats that learn. All their tensors stay where they are, so that a captured step goes on with them.

    Attributes:
        sources: Which Gaussian of the model each splat was made of, [N], on the host.
        invisible: Share of the splats that nobody sees at the start.
        adam: Improves them by the gradients that are on them.

    Args:
        unfitted: As they are at the start.
        views: The cameras that see them.
        sh_degree: Highest degree to learn.
        error: Root-mean-square error of their images in [0, 1].
    """

    def __init__(self, unfitted: Splats, views: Sequence[ViewTensors], sh_degree: int, error: float) -> None:
        self._centers, self._quats = unfitted.means.clone(), unfitted.quats.clone()
        self._units = unfitted.log_scales.exp()
        self._harmonics = SeenHarmonics(unfitted.means, views, sh_degree)
        coefficients = torch.cat([unfitted.sh0, unfitted.shN], dim=1)[:, : (sh_degree + 1) ** 2]
        values = {
            "means": torch.zeros_like(unfitted.means),
            "quats": unfitted.quats.clone(),
            "log_scales": unfitted.log_scales.clone(),
            "logit_opacities": unfitted.logit_opacities.clone(),
            "colors": self._harmonics.coordinates(coefficients),
        }
        self.learnt = {name: value.requires_grad_() for name, value in values.items()}
        self.sources = torch.arange(len(unfitted.means))
        self.invisible = (torch.sigmoid(unfitted.logit_opacities) < INVISIBLE_OPACITY).float().mean().item()
        device = unfitted.means.device
        self._first_rates = error * torch.tensor(list(RATES.values()), device=device)
        self.rates = self._first_rates.clone()
        groups = [
            {"params": [self.learnt[name]], "lr": rate} for name, rate in zip(RATES, self.rates.unbind(), strict=True)
        ]
        # of a captured step: the rates are read on the device
        kind, on_device = (WarpAdam, True) if device.type == "cuda" else (torch.optim.Adam, False)
        self.adam = kind(groups, betas=BETAS, eps=1e-15, fused=True, capturable=on_device)

    def set_rates(self, share: float) -> None:
        """Set the step sizes for the steps to come.

        Args:
            share: Of those at the start.
        """
        torch.mul(self._first_rates, share, out=self.rates)

    @property
    def splats(self) -> Splats:
        """The splats as they are now; gradients flow into all that learns."""
        learnt = self.learnt
        means = self._centers + rotate(self._quats, self._units * learnt["means"])
        coefficients = self._harmonics.coefficients(learnt["colors"])
        shape = learnt["quats"], learnt["log_scales"], learnt["logit_opacities"]
        return Splats(means, *shape, *coefficients.split((1, coefficients.shape[1] - 1), dim=1))

    @torch.no_grad()
    def detached(self) -> Splats:
        """A copy of the splats as they are now, without gradients."""
        splats = self.splats
        return Splats(**{field.name: getattr(splats, field.name).clone() for field in dataclasses.fields(Splats)})

    def relocate(self, exact: ExactImages, views: Sequence[ViewTensors], generator: torch.Generator) -> None:
        """Move faint splats; what has changed starts again with moments of zero.

        Args:
            generator: On the host; draws where they move.
        """
        splats = self.detached()
        moved, onto = moves(errors_of_splats(splats, exact, views), splats.logit_opacities, generator)
        relocate(splats, moved, onto)
        self.sources[moved.cpu()] = self.sources[onto.cpu()]
        changed = torch.cat([moved, onto])
        with torch.no_grad():
            self._centers[changed] = splats.means[changed]
            self._quats[changed] = splats.quats[changed]
            self._units[changed] = splats.log_scales[changed].exp()
            self._harmonics.from_coordinates[moved] = self._harmonics.from_coordinates[onto]
            learnt = self.learnt
            learnt["means"][changed] = 0.0
            for name in ("quats", "log_scales", "logit_opacities"):
                learnt[name][changed] = getattr(splats, name)[changed]
            learnt["colors"][moved] = learnt["colors"][onto]
        for state in self.adam.state.values():
            for moment in (state["exp_avg"], state["exp_avg_sq"]):
                moment[changed] = 0.0
