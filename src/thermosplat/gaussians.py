"""The Gaussians: their stored parameters, their activations, and their start from sparse points.

Notation: N Gaussians, d latent feature channels, K = (degree + 1)² spherical harmonics. ``log_`` and ``logit_`` mark
what is stored before its activation; the properties without the prefix are what the renderer takes.
"""

import math
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from thermosplat.config import ModelConfig
from thermosplat.errors import UserError
from thermosplat.neighbor_distances import NUM_NEIGHBORS, neighbor_distances

SH_C0 = 0.5 / math.sqrt(math.pi)
"""The constant spherical harmonic of degree 0: a colour c in [0, 1] is stored as sh0 = (c - 0.5) / SH_C0."""

LUMA_WEIGHTS = (0.299, 0.587, 0.114)
"""Luma of an RGB colour, ITU-R BT.601."""


class Gaussians(nn.Module):
    """A set of anisotropic 3D Gaussians.

    All parameters share their first dimension N, so that densification can treat them by name, without knowing them.

    Attributes:
        means: Centres [world units], shape [N, 3].
        quats: Rotations as wxyz quaternions, not necessarily normalised (the renderer does that), shape [N, 4].
        log_scales: Logarithms of the standard deviations along the axes [log world units], shape [N, 3].
        logit_opacities: Logits of the visible opacity α, shape [N].
        sh0: Spherical harmonics coefficients of degree 0, shape [N, 1, 3].
        shN: Coefficients of the higher degrees, shape [N, K-1, 3]; [N, 0, 3] for degree 0.
        features: Latent features f, rendered as they are, shape [N, d]; only where the model decodes features. With a
            basis their coordinates in it, shape [N, r].
        feature_basis: Orthonormal columns B, shape [d, r]: features are f = B c where Gaussians hold coordinates c of
            fewer channels, r < d (``training.feature_channels``). None: they hold f itself.
        thermal_sh0: As sh0, for the thermal image; only in a set that two spectra share without features.
        thermal_shN: As shN, for the thermal image; with thermal_sh0.
        thermal_opacity_offsets: Δ_t α, the thermal opacity is sigmoid(logit α + Δ_t α), shape [N]; only in a set that
            two spectra share, with geometric decoupling.
        logit_thermal_opacities: Logits of α_t in place of offsets, where ``ModelConfig.thermal_opacity`` is "own".

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
    thermal_sh0: nn.Parameter
    thermal_shN: nn.Parameter
    thermal_opacity_offsets: nn.Parameter
    logit_thermal_opacities: nn.Parameter

    def __init__(self, parameters: dict[str, Tensor]) -> None:
        super().__init__()
        basis = parameters.get("feature_basis")
        self.register_buffer("feature_basis", None if basis is None else basis.detach().clone())
        for name, value in parameters.items():
            if name != "feature_basis":
                setattr(self, name, nn.Parameter(value.detach().clone()))

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Tensor:
        """Standard deviations along the axes [world units], > 0, shape [N, 3]."""
        return torch.exp(self.log_scales)

    @property
    def opacities(self) -> Tensor:
        """Visible opacities α in (0, 1), shape [N]."""
        return torch.sigmoid(self.logit_opacities)

    @property
    def thermal_opacities(self) -> Tensor:
        """Thermal opacities α_t in (0, 1), shape [N]; α itself in a set with one opacity."""
        return torch.sigmoid(self.thermal_logits)

    @property
    def thermal_logits(self) -> Tensor:
        """Logits of α_t, shape [N]; those of α in a set with one opacity."""
        stored, is_offset = self.stored_thermal_opacities
        if stored is None:
            return self.logit_opacities
        return self.logit_opacities + stored if is_offset else stored

    @property
    def stored_thermal_opacities(self) -> tuple[Tensor | None, bool]:
        """Offsets to the logits of α, or logits of α_t, [N], and whether they are offsets; None with one opacity."""
        if "logit_thermal_opacities" in self._parameters:
            return self.logit_thermal_opacities, False
        if "thermal_opacity_offsets" in self._parameters:
            return self.thermal_opacity_offsets, True
        return None, False

    @torch.no_grad()
    def set_opacity_logits(self, indices: Tensor, visible: Tensor, thermal: Tensor) -> None:
        """Overwrite opacities, however the thermal one is stored; in a set with one opacity the visible one alone.

        Args:
            indices: Which Gaussians, int64, shape [n].
            visible: Logits of α, shape [n].
            thermal: Logits of α_t, shape [n].
        """
        dtype = self.logit_opacities.dtype
        self.logit_opacities[indices] = visible.to(dtype)
        if "logit_thermal_opacities" in self._parameters:
            self.logit_thermal_opacities[indices] = thermal.to(dtype)
        elif "thermal_opacity_offsets" in self._parameters:
            self.thermal_opacity_offsets[indices] = (thermal - visible).to(dtype)

    @property
    def sh_coeffs(self) -> tuple[Tensor, Tensor]:
        """Spherical harmonics coefficients as the renderer takes them: [N, 1, 3] of degree 0 and [N, K-1, 3]."""
        return self.sh0, self.shN

    @property
    def thermal_sh_coeffs(self) -> tuple[Tensor, Tensor]:
        """As ``sh_coeffs``, of the thermal image: coefficients of its own where two spectra share the set."""
        return (self.thermal_sh0, self.thermal_shN) if "thermal_sh0" in self._parameters else self.sh_coeffs

    @property
    def has_two_opacities(self) -> bool:
        """Whether α_t may differ from α."""
        return not {"logit_thermal_opacities", "thermal_opacity_offsets"}.isdisjoint(self._parameters)

    @property
    def has_features(self) -> bool:
        """Whether the Gaussians carry latent features."""
        return "features" in self._parameters

    def expanded(self, coordinates: Tensor) -> Tensor:
        """Features [..., d] of what Gaussians hold of them, or of what was blended of that, [..., r]."""
        return coordinates if self.feature_basis is None else coordinates @ self.feature_basis.T

    @classmethod
    def from_points(
        cls,
        points: NDArray[np.float32],
        colors: NDArray[np.uint8],
        *,
        config: ModelConfig,
        sh_degree: int,
        generator: torch.Generator,
        modality: Literal["rgb", "thermal"] | None = None,
    ) -> "Gaussians":
        """Gaussians at sparse points: round, faint, of the points' colours.

        Rotations start at the identity, as in 3DGS (gsplat draws them at random): the Gaussians start round, so the
        first images do not depend on it.

        Args:
            points: Positions [world units], shape [M, 3], M >= 4.
            colors: 8-bit RGB colours of the points, shape [M, 3].
            config: Says which parameters there are and how they start.
            sh_degree: Highest degree of the spherical harmonics, 0 to 3.
            generator: Source of the random features, on the CPU.
            modality: The one spectrum that a set of its own renders; such a set has neither features nor anything
                thermal beside its colours. None: a set for all modelled spectra. Thermal colours start grey, from the
                points' luma.

        Returns:
            M Gaussians on the CPU.

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
        num_points = len(points)
        point_colors = torch.as_tensor(np.asarray(colors, dtype=np.float32) / 255.0)
        luma = point_colors @ torch.tensor(LUMA_WEIGHTS)
        base_colors = luma[:, None].expand(-1, 3) if modality == "thermal" else point_colors
        log_distances = torch.as_tensor(np.log(neighbor_distances(points) * config.init_scale))
        parameters = {
            "means": torch.as_tensor(np.array(points, dtype=np.float32)),
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(num_points, 1),
            "log_scales": log_distances[:, None].repeat(1, 3),
            "logit_opacities": torch.logit(torch.full((num_points,), config.init_opacity)),
            "sh0": ((base_colors - 0.5) / SH_C0)[:, None, :],
            "shN": torch.zeros(num_points, (sh_degree + 1) ** 2 - 1, 3),
        }
        if modality is not None:
            return cls(parameters)
        if config.feature_dim > 0:
            # The first four channels are supervised as colour and thermal intensity, so they start as such.
            known = torch.cat([point_colors, luma[:, None]], dim=1)[:, : config.feature_dim]
            noise = torch.randn(num_points, config.feature_dim - known.shape[1], generator=generator)
            parameters["features"] = torch.cat([known, config.feature_noise * noise], dim=1)
        else:
            parameters["thermal_sh0"] = ((luma[:, None].expand(-1, 3) - 0.5) / SH_C0)[:, None, :]
            parameters["thermal_shN"] = torch.zeros_like(parameters["shN"])
        if config.geometric_decoupling and config.rgb and config.thermal:
            if config.thermal_opacity == "own":
                parameters["logit_thermal_opacities"] = parameters["logit_opacities"].clone()
            else:
                parameters["thermal_opacity_offsets"] = torch.zeros(num_points)
        return cls(parameters)

    @classmethod
    def from_state_dict(cls, state: dict[str, Tensor]) -> "Gaussians":
        """Gaussians of a checkpoint, as many and with the same parameters as it holds.

        Args:
            state: What ``state_dict()`` returned.

        Raises:
            KeyError: It lacks a parameter that every Gaussian has.
        """
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN"):
            if name not in state:
                raise KeyError(name)
        return cls(state)
