"""Images that are blended spherical harmonics: plain 3DGS, and ThermalGaussian's and MMOne's of every spectrum."""

from collections.abc import Callable

from torch import Tensor

from thermosplat.config import ModelConfig
from thermosplat.scene.formations.formation import Blended, Formation
from thermosplat.scene.gaussians import SH_C0, Gaussians, PointColors, sh_names
from thermosplat.spectra import Spectrum


class HarmonicFormation(Formation):
    """The image is what is blended of each Gaussian's SH colours.

    A one-channel image is the mean of three channels that start equal and get equal gradients: they stay grey, and so
    do exported splats.
    """

    takes_colors = True
    exact_splats = True

    @classmethod
    def is_for(cls, spectrum: Spectrum, model: ModelConfig) -> bool:
        """As of ``Formation``: there are no features."""
        return model.feature_dim == 0

    def initial(self, points: PointColors, *, is_first: bool) -> dict[str, Tensor]:
        """As of ``Formation``."""
        return {} if is_first else dict(zip(sh_names(self.name), points.harmonics(self.spectrum), strict=True))

    def render(self, blended: Blended, decoded: Tensor | None) -> Tensor:
        """As of ``Formation``.

        Raises:
            ValueError: No SH colours were blended.
        """
        if blended.colors is None:
            raise ValueError(f"{self.name} takes SH colours, and none were blended.")
        return self._of_channels(blended.colors)

    def image_of(self, gaussians: Gaussians) -> Tensor:
        """As of ``Formation``: the colour of degree 0."""
        return self._of_channels(0.5 + SH_C0 * gaussians.sh_coeffs_of(self.name)[0][:, 0])

    def harmonics(self, gaussians: Gaussians, shown: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """As of ``Formation``: the Gaussians' own, as they are."""
        return gaussians.sh_coeffs_of(self.name)

    def _of_channels(self, colors: Tensor) -> Tensor:
        return colors if self.spectrum.channels == 3 else colors.mean(dim=-1, keepdim=True)
