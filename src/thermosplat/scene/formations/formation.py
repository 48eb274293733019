"""How the image of one spectrum comes of what is blended of Gaussians: one object for each spectrum of a scene.

Gaussians are blended at the spectrum's opacity, which needs no knowledge of what they hold (``Blended``). All that is
one spectrum's own comes after that or before it, and its formation says it: what Gaussians hold for it, what a camera
makes of it, the image, its losses, and what files and viewers may show in its place. A kind of formation is a class.
The scene, its training, exports and viewers ask these methods and never which kind it is.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from thermosplat.config import DecoderConfig, LossConfig, ModelConfig
from thermosplat.fused.image_loss import ImageTerm
from thermosplat.scene.decoder import Decoder
from thermosplat.scene.gaussians import SH_C0, Gaussians, PointColors
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import Spectrum, SpectrumConfig
from thermosplat.thermal.radiometry import PixelScale

if TYPE_CHECKING:
    from thermosplat.datasets.capture import View
    from thermosplat.datasets.frame_tensors import ViewTensors


@dataclass(frozen=True, eq=False)
class Blended:
    """What a spectrum's camera sees of Gaussians, before it is an image."""

    view: "ViewTensors | None"
    """Camera and pose; None: from nowhere."""
    alpha: Tensor
    """Accumulated opacity in [0, 1], [H, W, 1]."""
    features: Tensor | None = None
    """A_f, [H, W, d]; None of Gaussians without features."""
    colors: Tensor | None = None
    """SH colours over the background, [H, W, 3]; None of a spectrum that takes none."""
    log_depth: Tensor | None = None
    """Σ w log z [log units of the scene], [H, W, 1]: over ``alpha`` the mean. None where nobody asked for depths."""
    background: Tensor | None = None
    """Colour behind photographs, [3]; None: black."""


@dataclass(frozen=True)
class LossTerm:
    """A loss that is worked out already."""

    name: str
    """Of the loss."""
    loss: Tensor
    """Weighted, a scalar."""


class Common(NamedTuple):
    """What the formations of a scene have in common."""

    model: ModelConfig
    """What Gaussians hold."""
    decoding: DecoderConfig
    """How features become images."""
    decoder: Decoder | None
    """The networks of all spectra; None of Gaussians without features."""
    photograph: str | None
    """The spectrum with SH colours beside features; None: there is none."""


class Formation(nn.Module):
    """How the image of one spectrum is formed; a kind of formation is a subclass.

    A formation's own parameters are trained as the decoders are. What Gaussians hold for it are SH coefficients under
    its name, or latent features.

    Attributes:
        spectrum: Which one.
        common: What it shares with those of the other spectra.

    Args:
        common: What it shares with those of the other spectra.
    """

    takes_features = False
    """Whether latent features are blended for it."""
    takes_colors = False
    """Whether SH colours are blended for it."""
    decodes = False
    """Whether the scene's decoder has networks for it (``decoder_input``)."""
    needs_depth = False
    """Whether depths are blended for it: ``Blended.log_depth`` is there."""
    exact_splats = False
    """Whether ``harmonics`` show its images as they are."""
    layers: tuple[str, ...] = ()
    """What else a viewer may show of it, by name (``layer``)."""
    classes: tuple[str, ...] = ()
    """Names of the classes that its images tell (``classes_in``)."""

    def __init__(self, spectrum: Spectrum, common: Common) -> None:
        super().__init__()
        self.spectrum = spectrum
        self.common = common  # a tuple: the decoder in it is the scene's, not a part of this module

    @classmethod
    def is_for(cls, spectrum: Spectrum, model: ModelConfig) -> bool:
        """Whether a spectrum has this kind of formation.

        Args:
            spectrum: The spectrum, with its settings.
            model: What Gaussians hold.
        """
        raise NotImplementedError

    @property
    def name(self) -> str:
        """The spectrum's name."""
        return self.spectrum.name

    # ---- before anything is blended ----------------------------------------------------------------------------------

    def begin(self, scale: PixelScale, views: "Sequence[View]") -> None:
        """Take over what the capture says of the spectrum's images, before training.

        Args:
            scale: What its pixels mean.
            views: Those that are trained on, of the spectrum.
        """

    def initial(self, points: PointColors, *, is_first: bool) -> dict[str, Tensor]:
        """What Gaussians hold for this spectrum alone, at the start of training.

        A set always has opacities, SH coefficients of its first spectrum and, where the model has them, features.

        Args:
            points: The sparse points that they start from, M of them.
            is_first: It is the set's first spectrum.

        Returns:
            Parameters [M, ...] by name.
        """
        return {}

    def basis_of_images(self) -> Tensor | None:
        """Orthonormal rows in which its images are read, [n, channels]; None: they are read as they are."""
        return None

    # ---- the image ---------------------------------------------------------------------------------------------------

    def through_optics(self, blended: Blended) -> Blended:
        """What the spectrum's camera makes of what it sees: losses on features see that.

        Args:
            blended: As it was blended.
        """
        return blended

    def decoder_input(self, features: Tensor | None, view: "ViewTensors | None") -> Tensor | None:
        """What the scene's decoder takes for this spectrum; None: it decodes nothing.

        Args:
            features: A_f, [H, W, d]; without a view any shape [..., d].
            view: From where they are seen; None: from nowhere.
        """
        return None

    def decoded(self, features: Tensor | None) -> Tensor | None:
        """What the scene's decoder makes of features for this spectrum alone; None: nothing."""
        inputs, decoder = self.decoder_input(features, None), self.common.decoder
        return None if inputs is None or decoder is None else decoder.image(self.name, inputs)

    def render(self, blended: Blended, decoded: Tensor | None) -> Tensor:
        """The image, [H, W, channels].

        Args:
            blended: As ``through_optics`` returned it.
            decoded: What the scene's decoder made of ``decoder_input``, [H, W, channels] in (0, 1).
        """
        raise NotImplementedError

    # ---- its losses --------------------------------------------------------------------------------------------------

    def losses(
        self, rendered: RenderedFrame, view: "ViewTensors", settings: SpectrumConfig, weights: LossConfig
    ) -> list[ImageTerm | LossTerm]:
        """What its images are compared by; of an image, L1 and SSIM, and those of its latent channels.

        Args:
            rendered: A render that has this spectrum.
            view: The same view with its image.
            settings: The spectrum's, with the weights of its own losses.
            weights: Those of all spectra.
        """
        return image_terms(self.name, self.spectrum.latent[0], rendered, view, settings, weights)

    # ---- what others show of it --------------------------------------------------------------------------------------

    def pixels_of_features(self, features: Tensor, alpha: Tensor, view: "ViewTensors", every: int) -> Tensor:
        """What of its image answers to features, at each so many-th pixel, [P, channels]; gradients reach them alone.

        Args:
            features: A_f, [H, W, d].
            alpha: Accumulated opacity, [H, W, 1].
            view: Camera and pose.
            every: So many-th.
        """
        raise NotImplementedError

    def image_of(self, gaussians: Gaussians) -> Tensor:
        """What each Gaussian looks like alone, from nowhere in particular, [N, channels].

        Args:
            gaussians: The set that renders this spectrum.
        """
        raise NotImplementedError

    def harmonics(self, gaussians: Gaussians, shown: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """SH coefficients [N, 1, 3] and [N, K-1, 3] by which other programs show this spectrum.

        Args:
            gaussians: The set that renders it.
            shown: Turns images [..., channels] into colours [..., 3].
        """
        colors = shown(self.image_of(gaussians))
        return (colors[:, None] - 0.5) / SH_C0, torch.zeros_like(gaussians.shN)

    def behind(self, background: Tensor) -> Tensor:
        """What its images show where there are no Gaussians, [channels].

        Args:
            background: Colour behind photographs, [3].
        """
        nothing = torch.zeros(1, 1, self.common.model.feature_dim, device=background.device)
        colors = background if self.spectrum.is_photograph else torch.zeros_like(background)
        features = nothing if self.takes_features else None
        blended = Blended(None, colors.new_zeros(1, 1, 1), features, colors.expand(1, 1, 3), background=background)
        return self.render(self.through_optics(blended), self.decoded(features))[0, 0]

    def layer(self, layer: str, rendered: RenderedFrame) -> Tensor:
        """One of ``layers``, [H, W].

        Args:
            layer: Its name.
            rendered: A render that has this spectrum.
        """
        raise NotImplementedError

    def ask(self, query: Tensor) -> bool:
        """Let one of ``layers`` show how well pixels fit a direction; whether images are such that they can.

        Args:
            query: Numbers, [channels].

        Raises:
            UserError: It has another number of channels, or is no direction.
        """
        return False

    def layer_range(self, layer: str) -> tuple[float, float]:
        """Values of one of ``layers`` at the ends of its palette.

        Args:
            layer: Its name.
        """
        return 0.0, 1.0

    def scores(self, image: Tensor, target: Tensor, mask: Tensor | None) -> Mapping[str, float]:
        """What a held-out image is judged by beside PSNR, SSIM, LPIPS and errors of measured values, by name.

        Args:
            image: The image, clamped to [0, 1], [H, W, channels].
            target: What it should have been, [H, W, channels].
            mask: bool [H, W], which pixels count; None: all.
        """
        return {}

    def classes_in(self, image: Tensor) -> Tensor:
        """The number of each pixel's class among ``classes``, [H, W] integers; another number: none.

        Args:
            image: Its image or render, [H, W, channels].
        """
        raise NotImplementedError

    def graded(self, rendered: RenderedFrame) -> Tensor:
        """Its image in values that change little where the scene does, [H, W, K]."""
        return rendered.images[self.name]

    def graded_truth(self, image: Tensor) -> Tensor:
        """What ``graded`` should be, [H, W, K], of an image [H, W, channels]."""
        return image

    def numbers(self) -> Mapping[str, float]:
        """What training has found beside images, for metrics.json, by name."""
        return {}


def image_terms(
    name: str,
    first: int,
    rendered: RenderedFrame,
    view: "ViewTensors",
    settings: SpectrumConfig,
    weights: LossConfig,
) -> list[ImageTerm | LossTerm]:
    """The image losses of a spectrum (equations 10 and 11 of docs/method.md): those that have a weight and an image.

    Args:
        name: The spectrum, by which its image's loss is called.
        first: The first latent channel that stands for its image.
        rendered: The render.
        view: The view with its image.
        weights: Those of all spectra.

    Returns:
        At most one of the image and one of the features, "features_<spectrum>".
    """
    terms: list[ImageTerm | LossTerm] = []
    image = rendered.images.get(name)
    if settings.loss > 0 and image is not None and view.image is not None:
        compared, truth = (image, view.image) if view.mask is None else masked(image, view.image, view.mask)
        terms.append(ImageTerm(name, settings.loss, compared, truth, 0, settings.squared))
    weight = weights.features * (settings.features or 0.0)
    # latent channels stand for an intensity, of a photograph for colours
    target = view.image if view.intensity is None else view.intensity[..., None]
    blended = rendered.features.get(name)
    if weight > 0 and blended is not None and target is not None:
        if view.mask is not None:
            blended, target = masked(blended, target, view.mask, first)
        terms.append(ImageTerm(f"features_{name}", weight, blended, target, first))
    return terms


def masked(image: Tensor, target: Tensor, mask: Tensor, first: int = 0) -> tuple[Tensor, Tensor]:
    """An image and its target for losses that shall not see some pixels.

    There the image gets no gradient, and the target is the image, which leaves no difference to any loss; a window of
    SSIM that reaches beyond a mask's edge sees the same on both sides.

    Args:
        image: [H, W, X].
        target: [H, W, C].
        mask: bool [H, W], which pixels count.
        first: The target is compared with the image's channels from this one on.
    """
    counts, held = mask[..., None], image.detach()
    seen = held[..., first : first + target.shape[-1]].clamp(0.0, 1.0)
    return torch.where(counts, image, held), torch.where(counts, target, seen)
