"""SH colours of a set without features, as the spectra of one camera see them: in which traversals they are blended."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from thermosplat.scene.formations.formation import Blended
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.scene.views import Rendering, note_call, render_two_opacities, render_view
from thermosplat.spectra import Spectrum

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors


def blend_harmonics(
    sets: Mapping[str, Gaussians],
    spectra: Sequence[Spectrum],
    view: "ViewTensors",
    rendering: Rendering,
    rendered: RenderedFrame,
    *,
    leading: str,
) -> dict[str, Blended]:
    """SH colours of spectra, the first two of a shared set by one traversal, the others one by one.

    Args:
        sets: Gaussians by name, "shared" or a spectrum's.
        spectra: The spectra, in the model's order.
        leading: The model's first spectrum, whose harmonics the first pass of a shared set has.
    """
    blended: dict[str, Blended] = {}
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
        of_first = output.render_alphas.squeeze(0), None, output.render_colors.squeeze(0)
        blended[first.name] = Blended(view, *of_first)
        blended[second.name] = Blended(view, alphas.squeeze(0), None, colors.squeeze(0))
        note_call(rendered, SHARED, [first.name, second.name], output.info)
    for spectrum in rest:
        name = spectrum.name
        own_set = name if name in sets else SHARED
        gaussians = sets[own_set]
        colors, alpha, info = render_view(
            gaussians,
            gaussians.sh_coeffs_of(name),
            gaussians.logits_in(name),
            view,
            rendering,
            backgrounds=rendering.backgrounds if spectrum.is_photograph else None,
        )
        blended[name] = Blended(view, alpha, None, colors)
        if not rendering.geometry_held:
            note_call(rendered, own_set, [name], info)
    return blended
