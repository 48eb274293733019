"""The Gaussians: their stored parameters, their activations, and their start from sparse points.

Notation: N Gaussians, d latent feature channels, K = (degree + 1)² spherical harmonics. ``log_`` and ``logit_`` mark
what is stored before its activation; the properties without the prefix are what the renderer takes.

A set renders one spectrum or several. The first has the parameters without a name in front; what another one has of its
own is called by its name: ``thermal_opacity_offsets``, ``logit_thermal_opacities``, ``thermal_sh0``, ``thermal_shN``.
"""

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from thermosplat.config import ModelConfig
from thermosplat.errors import UserError
from thermosplat.scene.neighbor_distances import NUM_NEIGHBORS
from thermosplat.spectra import Spectrum

if TYPE_CHECKING:
    from thermosplat.scene.formations.formation import Formation

SH_C0 = 0.5 / math.sqrt(math.pi)
"""The constant spherical harmonic of degree 0: a colour c in [0, 1] is stored as sh0 = (c - 0.5) / SH_C0."""

LUMA_WEIGHTS = (0.299, 0.587, 0.114)
"""Luma of an RGB colour, ITU-R BT.601."""

FEATURE_NOISE = 0.2
"""Standard deviation of the first features that have no colour to start from. Open choice: MS-Splatting's."""

OFFSETS = "_opacity_offsets"
"""End of the name of a spectrum's opacity offsets."""


def offsets_name(spectrum: str) -> str:
    """Parameter with the offsets of a spectrum's opacity."""
    return f"{spectrum}{OFFSETS}"


def own_logits_name(spectrum: str) -> str:
    """Parameter with the logits of a spectrum's own opacity."""
    return f"logit_{spectrum}_opacities"


def sh_names(spectrum: str) -> tuple[str, str]:
    """Parameters with the SH coefficients of a spectrum that is not the first of its set."""
    return f"{spectrum}_sh0", f"{spectrum}_shN"


class StoredOpacity(NamedTuple):
    """A second opacity as Gaussians store it."""

    values: Tensor | None
    """[N]; None: the spectrum has α."""
    is_offset: bool
    """Whether they are offsets to the logits of α, or logits themselves."""


class PointColors(NamedTuple):
    """What is known of sparse points before training, and what Gaussians begin with for a spectrum."""

    colors: Tensor
    """RGB in [0, 1], [M, 3]."""
    luma: Tensor
    """The same in grey, [M, 1]."""
    num_bases: int
    """Spherical harmonics above degree 0, K - 1."""

    @classmethod
    def of(cls, colors: NDArray[np.uint8], sh_degree: int) -> "PointColors":
        """Of 8-bit colours [M, 3], and the highest degree of the spherical harmonics."""
        known = torch.as_tensor(np.asarray(colors, dtype=np.float32) / 255.0)
        return cls(known, (known @ torch.tensor(LUMA_WEIGHTS))[:, None], (sh_degree + 1) ** 2 - 1)

    def in_spectrum(self, spectrum: Spectrum) -> Tensor:
        """What a spectrum is taken to see: photographs the colours [M, 3], others the luma [M, 1]."""
        return self.colors if spectrum.is_photograph else self.luma

    def harmonics(self, spectrum: Spectrum) -> tuple[Tensor, Tensor]:
        """SH coefficients of that, [M, 1, 3] of degree 0, and zeros [M, K-1, 3]."""
        known = self.in_spectrum(spectrum).expand(-1, 3)
        return ((known - 0.5) / SH_C0)[:, None, :], torch.zeros(len(known), self.num_bases, 3)


class Gaussians(nn.Module):
    """A set of anisotropic 3D Gaussians.

    All parameters share their first dimension N, so that densification can treat them by name, without knowing them.

    Attributes:
        means: Centres [world units], shape [N, 3].
        quats: Rotations as wxyz quaternions, not necessarily normalised (the renderer does that), shape [N, 4].
        log_scales: Logarithms of the standard deviations along the axes [log world units], shape [N, 3].
        logit_opacities: Logits of α, the opacity in the first spectrum, shape [N].
        sh0: Spherical harmonics coefficients of degree 0 of the first spectrum, shape [N, 1, 3].
        shN: Coefficients of the higher degrees, shape [N, K-1, 3]; [N, 0, 3] for degree 0.
        features: Latent features f, rendered as they are, shape [N, d]; only where the model decodes features. With a
            basis their coordinates in it, shape [N, r].
        feature_basis: Orthonormal columns B, shape [d, r]: features are f = B c where Gaussians hold coordinates c of
            fewer channels, r < d (``training.budget.feature_channels``). None: they hold f itself.
        <spectrum>_sh0, <spectrum>_shN: As sh0 and shN, of a further spectrum; in a set without features.
        <spectrum>_opacity_offsets: Δ, the opacity in that spectrum is sigmoid(logit α + Δ), shape [N].
        logit_<spectrum>_opacities: Logits of the opacity in that spectrum, shape [N], in place of offsets.

    Args:
        parameters: Initial value of each parameter by its name; the optional ones may be missing. Where there is a
            basis, it is among them.
    """

    feature_basis: Tensor | None

    means: nn.Parameter
    quats: nn.Parameter
    log_scales: nn.Parameter
    logit_opacities: nn.Parameter
    sh0: nn.Parameter
    shN: nn.Parameter
    features: nn.Parameter

    def __init__(self, parameters: dict[str, Tensor]) -> None:
        super().__init__()
        basis = parameters.get("feature_basis")
        self.register_buffer("feature_basis", None if basis is None else basis.detach().clone())
        for name, value in parameters.items():
            if name != "feature_basis":
                setattr(self, name, nn.Parameter(value.detach().clone()))
        self.second_opacities = tuple(
            spectrum for name in parameters if (spectrum := _spectrum_of_opacity(name)) is not None
        )
        """Spectra in which the Gaussians have another opacity than α."""

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Tensor:
        """Standard deviations along the axes [world units], > 0, shape [N, 3]."""
        return torch.exp(self.log_scales)

    @property
    def opacities(self) -> Tensor:
        """Opacities α in the first spectrum, in (0, 1), shape [N]."""
        return torch.sigmoid(self.logit_opacities)

    def opacities_in(self, spectrum: str) -> Tensor:
        """Opacities in a spectrum, in (0, 1), shape [N]; α where it has none of its own."""
        return torch.sigmoid(self.logits_in(spectrum))

    def logits_in(self, spectrum: str) -> Tensor:
        """Logits of the opacities in a spectrum, shape [N]; those of α where it has none of its own."""
        stored, is_offset = self.stored_opacity(spectrum)
        if stored is None:
            return self.logit_opacities
        return self.logit_opacities + stored if is_offset else stored

    def stored_opacity(self, spectrum: str) -> StoredOpacity:
        """What is stored of the opacity in a spectrum beside α."""
        for name, is_offset in ((own_logits_name(spectrum), False), (offsets_name(spectrum), True)):
            if (values := getattr(self, name, None)) is not None:
                return StoredOpacity(values, is_offset)
        return StoredOpacity(None, False)

    @property
    def stored_second_opacity(self) -> StoredOpacity:
        """The opacity that kernels for two opacities take beside α: of several the largest, Gaussian by Gaussian."""
        if len(self.second_opacities) < 2:
            return (
                self.stored_opacity(self.second_opacities[0]) if self.second_opacities else StoredOpacity(None, False)
            )
        return StoredOpacity(reduce(torch.maximum, map(self.logits_in, self.second_opacities)), False)

    @property
    def largest_opacities(self) -> Tensor:
        """The largest opacity of each Gaussian over the spectra, in (0, 1), shape [N]."""
        return reduce(torch.maximum, map(self.opacities_in, self.second_opacities), self.opacities)

    @torch.no_grad()
    def set_opacity_logits(self, indices: Tensor, first: Tensor, others: Mapping[str, Tensor]) -> None:
        """Overwrite opacities, however they are stored.

        Args:
            indices: Which Gaussians, int64, shape [n].
            first: Logits of α, shape [n].
            others: Logits of the opacity by spectrum, shape [n]; of each of ``second_opacities``.
        """
        dtype = self.logit_opacities.dtype
        self.logit_opacities[indices] = first.to(dtype)
        for spectrum in self.second_opacities:
            stored, is_offset = self.stored_opacity(spectrum)
            if stored is not None:
                stored[indices] = ((others[spectrum] - first) if is_offset else others[spectrum]).to(dtype)

    @property
    def sh_coeffs(self) -> tuple[Tensor, Tensor]:
        """Spherical harmonics coefficients as the renderer takes them: [N, 1, 3] of degree 0 and [N, K-1, 3]."""
        return self.sh0, self.shN

    def sh_coeffs_of(self, spectrum: str) -> tuple[Tensor, Tensor]:
        """As ``sh_coeffs``, of a spectrum: coefficients of its own where it is not the first of a set without
        features."""
        first, higher = sh_names(spectrum)
        return (getattr(self, first), getattr(self, higher)) if hasattr(self, first) else self.sh_coeffs

    @property
    def has_features(self) -> bool:
        """Whether the Gaussians carry latent features."""
        return hasattr(self, "features")

    def expanded(self, coordinates: Tensor) -> Tensor:
        """Features [..., d] of what Gaussians hold of them, or of what was blended of that, [..., r]."""
        return coordinates if self.feature_basis is None else coordinates @ self.feature_basis.T

    @classmethod
    def from_points(
        cls,
        points: NDArray[np.float32],
        colors: NDArray[np.uint8],
        sizes: NDArray[np.float32],
        *,
        config: ModelConfig,
        sh_degree: int,
        generator: torch.Generator,
        formations: Sequence["Formation"],
    ) -> "Gaussians":
        """Gaussians at sparse points: round, faint, of the points' colours.

        Rotations start at the identity, as in 3DGS (gsplat draws them at random): the Gaussians start round, so the
        first images do not depend on it.

        Args:
            points: Positions [world units], shape [M, 3], M >= 4.
            colors: 8-bit RGB colours of the points, shape [M, 3].
            sizes: First standard deviations [world units], positive, shape [M].
            config: Says which parameters there are and how they start.
            sh_degree: Highest degree of the spherical harmonics, 0 to 3.
            generator: Source of the random features, on the CPU.
            formations: Of the spectra that the set renders, at least one. Photographs start in the points' colours,
                others grey, from the points' luma.

        Returns:
            M Gaussians on the CPU.
        """
        num_points = len(points)
        known = PointColors.of(colors, sh_degree)
        spectra = [formation.spectrum for formation in formations]
        sh0, shN = known.harmonics(spectra[0])
        log_sizes = torch.as_tensor(np.log(sizes))
        parameters = {
            "means": torch.as_tensor(np.array(points, dtype=np.float32)),
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(num_points, 1),
            "log_scales": log_sizes[:, None].repeat(1, 3),
            "logit_opacities": torch.logit(torch.full((num_points,), config.init_opacity)),
            "sh0": sh0,
            "shN": shN,
        }
        if config.feature_dim > 0:
            # Channels that are supervised as colours or intensities start as such.
            started = [known.in_spectrum(one)[:, : one.latent[1] - one.latent[0]] for one in spectra]
            others = config.feature_dim - sum(channels.shape[1] for channels in started)
            noise = torch.randn(num_points, others, generator=generator)
            parameters["features"] = torch.cat([*started, FEATURE_NOISE * noise], dim=1)
        for place, formation in enumerate(formations):
            parameters |= formation.initial(known, is_first=place == 0)
        for spectrum in spectra[1:]:
            if spectrum.opacity == "own":
                parameters[own_logits_name(spectrum.name)] = parameters["logit_opacities"].clone()
            elif spectrum.opacity == "offset":
                parameters[offsets_name(spectrum.name)] = torch.zeros(num_points)
        return cls(parameters)


def _spectrum_of_opacity(name: str) -> str | None:
    """The spectrum whose opacity a parameter holds; None of another parameter, and of α."""
    if name.endswith(OFFSETS):
        return name.removesuffix(OFFSETS)
    prefix, suffix = "logit_", "_opacities"
    inner = name.removeprefix(prefix).removesuffix(suffix)
    return inner if name == f"{prefix}{inner}{suffix}" else None


def check_points(points: NDArray[np.float32]) -> None:
    """Refuse sparse points that no Gaussians can start from.

    Args:
        points: Positions [world units], shape [M, 3].

    Raises:
        UserError: If there are too few points, or some are not finite.
    """
    if len(points) <= NUM_NEIGHBORS:
        raise UserError(
            f"Training starts from at least {NUM_NEIGHBORS + 1} sparse points, but the capture has {len(points)}.",
            "Make them with COLMAP: colmap mapper, or colmap point_triangulator where the poses are known.",
        )
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(axis=1).sum())
        raise UserError(
            f"{bad} of the capture's {len(points)} sparse points have coordinates that are not finite numbers.",
            "Make the model again with COLMAP: colmap point_triangulator.",
        )
