"""Spectra of one camera from their spherical harmonics: in which traversals they are rendered."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.scene.views import Rendering, render_two_opacities, render_view
from thermosplat.spectra import Spectrum

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors


def render_harmonics(
    sets: Mapping[str, Gaussians],
    spectra: Sequence[Spectrum],
    view: "ViewTensors",
    rendering: Rendering,
    rendered: RenderedFrame,
    *,
    leading: str,
) -> None:
    """Images of spectra without features: the first two of a shared set by one traversal, the others one by one.

    Args:
        sets: Gaussians by name, "shared" or a spectrum's.
        spectra: The spectra, in the model's order.
        view: Their camera and pose.
        rendering: How.
        rendered: Takes images, accumulated opacities, and what rasterizations say about their calls.
        leading: The model's first spectrum, whose harmonics the first pass of a shared set has.
    """
    rest = list(spectra)
    if len(spectra) > 1 and spectra[0].name == leading:
        first, second, *rest = spectra
        gaussians = sets[SHARED]
        has_own = second.name in gaussians.second_opacities
        sh_coeffs = gaussians.sh_coeffs_of(second.name)
        output = render_two_opacities(gaussians, second.name if has_own else None, sh_coeffs, view, rendering)
        colors, alphas = output.render_thermal_features, output.render_thermal_alphas
        if colors is None or alphas is None:
            colors, alphas = output.render_features, output.render_alphas
        rendered.images[first.name] = _image(first, output.render_colors.squeeze(0))
        rendered.images[second.name] = _image(second, colors.squeeze(0))
        rendered.alphas[first.name] = output.render_alphas.squeeze(0)
        rendered.alphas[second.name] = alphas.squeeze(0)
        rendered.note_call(SHARED, [first.name, second.name], output.info)
    for spectrum in rest:
        name = spectrum.name
        own_set = name if name in sets else SHARED
        gaussians = sets[own_set]
        image, rendered.alphas[name], info = render_view(
            gaussians,
            gaussians.sh_coeffs_of(name),
            gaussians.logits_in(name),
            view,
            rendering,
            backgrounds=rendering.backgrounds if spectrum.is_photograph else None,
        )
        rendered.images[name] = _image(spectrum, image)
        if not rendering.geometry_held:
            rendered.note_call(own_set, [name], info)


def _image(spectrum: Spectrum, colors: Tensor) -> Tensor:
    """A spectrum's image [H, W, channels] of its blended SH colours [H, W, 3].

    A one-channel image is the mean of three channels that start equal and get equal gradients: they stay grey, and so
    does the exported PLY.
    """
    return colors if spectrum.channels == 3 else colors.mean(dim=-1, keepdim=True)
