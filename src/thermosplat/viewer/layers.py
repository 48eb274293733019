"""What can be looked at of a scene, one layer each: images of its spectra, depth, opacity, features, errors.

A layer of values is a field [H, W] in its own unit, NaN where there is nothing; a layer of colours has an image. Layers
of one view share one traversal of the Gaussians, and what is not asked for is not rendered.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.evaluation.held_out import LARGEST_ERROR, LARGEST_MEASURED_ERROR
from thermosplat.pictures.display_palettes import display_palette
from thermosplat.pictures.image_display import Image8
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.scene.views import Rendering, render_view
from thermosplat.spectra import label, unit_label
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermal.radiometry import Palette, PixelScale
from thermosplat.thermography.certainty import DOUBTS, Sure
from thermosplat.thermography.scene_temperatures import SceneTemperatures, Surroundings, Values
from thermosplat.viewer.feature_colors import FeatureColors
from thermosplat.viewer.photographs import Photographs
from thermosplat.viewer.viewed_scene import ViewedScene

_LABELS = {
    "image": "{}",
    "before": "before, {}",
    "change": "change, {}",
    "depth": "depth, {}",
    "opacity": "opacity, {}",
    "offset": "opacity offset, {}",
    "features": "features, {}",
    "doubt": "how sure, {}",
    "error": "error, {}",
    "photograph": "photograph, {}",
}
_OTHERS = ("depth", "offset", "doubt", "photograph", "before")
"""Layers that a render of the spectrum's image does not have."""
_SAME_PLACE = 0.03
"""Share by which the depths of two dates may differ: a car that stands 1.4 m high is 5% of a flight at 30 m."""


@dataclass(frozen=True)
class Layer:
    """One thing to look at, in one spectrum."""

    kind: str
    """What it is: one of those that every scene has, or of the spectrum's ``Formation.layers``."""
    spectrum: str

    @property
    def label(self) -> str:
        """Its name on the page."""
        return _LABELS.get(self.kind, f"{self.kind}, {{}}").format(label(self.spectrum))


@dataclass(frozen=True, eq=False)
class LayerImage:
    """A layer as it was rendered from one view."""

    layer: Layer
    field: NDArray[np.float32] | None
    """Values, shape [H, W], NaN where there is none; None of a layer of colours."""
    colors: Image8 | None
    """8-bit colours, shape [H, W, 3]; None of a layer of values."""
    palette: Palette
    """Palette that its values are shown with where nobody asks for another one."""
    range: tuple[float, float] | None
    """Values at the palette's ends where nobody asks for others; None: those of the picture."""
    unit: str = ""
    """Unit of the values for people, such as "°C"; "" where they have none."""
    quantity: str = ""
    """What the values are, such as "temperature"."""
    decimals: int = 2
    """Digits behind the point that its values are shown with."""
    changed: NDArray[np.bool_] | None = None
    """Where temperatures were recalculated, or in "how sure" may be read, shape [H, W]; None: it does not matter."""
    reasons: tuple[str, ...] = ()
    """Why they were not, or may not, elsewhere; a sentence each."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        shown = self.field if self.field is not None else self.colors
        assert shown is not None  # noqa: S101  one of them is there
        return shown.shape[1], shown.shape[0]


def available_layers(scene: ViewedScene) -> list[Layer]:
    """The layers that a scene has, images first."""
    model, spectra = scene.model, list(scene.model.spectra)
    layers = [Layer("image", name) for name in spectra]
    if scene.earlier is not None:
        layers += [Layer("change", scene.earlier.spectrum)]
        layers += [Layer("before", name) for name in spectra if name in scene.earlier.scene.scales]
    layers += [Layer("depth", name) for name in spectra]
    layers += [Layer("opacity", name) for name in spectra]
    for name in spectra:
        if name in model.gaussians(model.set_of(name)).second_opacities:
            layers.append(Layer("offset", name))
    layers += [Layer("features", name) for name in spectra if model.formations[name].takes_features]
    layers += [Layer(kind, name) for name in spectra for kind in model.formations[name].layers]
    photographed = [name for name in spectra if any(name in frame.views for frame in scene.frames)]
    layers += [Layer("doubt", name) for name in scene.certainties]
    layers += [Layer("error", name) for name in photographed]
    layers += [Layer("photograph", name) for name in photographed]
    return layers


class LayerRenderer:
    """Renders layers of a scene."""

    def __init__(self, scene: ViewedScene) -> None:
        self.scene = scene
        self.photographs = Photographs(scene)

    @torch.no_grad()
    def render(
        self,
        layers: Iterable[Layer],
        view: ViewTensors,
        *,
        values: bool = True,
        temperatures: SceneTemperatures | None = None,
    ) -> dict[Layer, LayerImage]:
        """Render layers from one view.

        Args:
            view: Camera and pose, on the model's device.
            values: Also the values behind pseudo-colours, which takes a while; without, such a layer has its colours.
            temperatures: How temperatures are recalculated; None: they are not.
        """
        shown = _Temperatures(temperatures or SceneTemperatures(self.scene.model, self.scene.scales), view)
        scene, wanted = self.scene, list(dict.fromkeys(layers))
        from_model = {layer.spectrum for layer in wanted if layer.kind not in _OTHERS}
        rendered = RenderedFrame()
        if from_model:
            rendered = scene.model.render(dict.fromkeys(from_model, view), sh_degree=scene.sh_degree)
        return {layer: self._layer(layer, view, rendered, values, shown) for layer in wanted}

    def _layer(
        self, layer: Layer, view: ViewTensors, rendered: RenderedFrame, values: bool, shown: "_Temperatures"
    ) -> LayerImage:
        name, scale = layer.spectrum, self.scene.scales[layer.spectrum]
        if layer.kind == "image":
            span = self.scene.display_ranges.get(name)
            return image_layer(layer, rendered.images[name], scale, values=values, temperatures=shown, shown=span)
        if layer.kind == "before":
            return self._before(name, view, values)
        if layer.kind == "change":
            return self._change(name, view, rendered)
        if layer.kind == "depth":
            model = self.scene.model
            depth = model.placement.unit * model.render_depth(name, view)
            field = torch.where(depth > 0, depth, torch.nan).cpu().numpy()
            return LayerImage(layer, field, None, display_palette("turbo"), None, "world units", "depth", 3)
        if layer.kind == "doubt":
            sure = self.how_sure(Layer("image", name), view)
            field = np.full((view.height, view.width), np.nan) if sure is None else sure.half_width
            doubted = None if sure is None else sure.doubts == 0
            reasons = () if sure is None else tuple(text for bit, text in DOUBTS.items() if (sure.doubts & bit).any())
            unit = unit_label(scale.measured_unit or "")
            shown_field, inferno = field.astype(np.float32), display_palette("inferno")
            said = tuple(f"hatched, not to be read: {reason}" for reason in reasons)
            return LayerImage(layer, shown_field, None, inferno, None, unit, "±", changed=doubted, reasons=said)
        if layer.kind == "opacity":
            field = rendered.alphas[name][..., 0].cpu().numpy()
            return LayerImage(layer, field, None, display_palette("white hot"), (0.0, 1.0), "", "opacity", 3)
        if layer.kind == "offset":
            field = self._offset(name, view).cpu().numpy()
            return LayerImage(layer, field, None, display_palette("blue red"), (-4.0, 4.0), "", "opacity offset")
        if layer.kind == "features":
            colors = _bytes(self.features_basis.colors(rendered.features[name], rendered.alphas[name]))
            return LayerImage(layer, None, colors, display_palette("white hot"), None, "", "features")
        formation = self.scene.model.formations[name]
        if layer.kind in formation.layers:
            field = formation.layer(layer.kind, rendered).cpu().numpy()
            span = formation.layer_range(layer.kind)
            return LayerImage(layer, field, None, display_palette("white hot"), span, "", layer.kind, 3)
        photograph = self.photographs.nearest(name, view)
        if layer.kind == "photograph":
            taken, valid = torch.nan_to_num(photograph.image), photograph.valid
            span = self.scene.display_ranges.get(name)
            return image_layer(layer, taken, scale, values=values, valid=valid, temperatures=shown, shown=span)
        return self._error(layer, rendered.images[name].clamp(0, 1), photograph.image, scale, shown)

    def _before(self, name: str, view: ViewTensors, values: bool = True) -> LayerImage:
        """The image of the earlier date, not recalculated."""
        earlier = self.scene.earlier
        assert earlier is not None  # noqa: S101  there is such a layer
        then, scene = earlier.view(view), earlier.scene
        image = scene.model.render({name: then}, sh_degree=scene.sh_degree).images[name]
        span = self.scene.display_ranges.get(name)
        return image_layer(Layer("before", name), image, scene.scales[name], values=values, shown=span)

    def _change(self, name: str, view: ViewTensors, rendered: RenderedFrame) -> LayerImage:
        """What became warmer or colder beyond what everything did; nothing where no spectrum has the same depth, as a
        thing is gone or new there."""
        layer, earlier = Layer("change", name), self.scene.earlier
        assert earlier is not None  # noqa: S101  there is such a layer
        now = image_layer(layer, rendered.images[name], self.scene.scales[name], values=True)
        before = self._before(name, view)
        same = torch.zeros(view.height, view.width, dtype=torch.bool, device=view.viewmat.device)
        for spectrum in filter(earlier.scene.scales.__contains__, self.scene.model.spectra):
            depth = self.scene.model.render_depth(spectrum, view)
            then = earlier.to_later.scale * earlier.scene.model.render_depth(spectrum, earlier.view(view))
            same |= (depth > 0) & (then > 0) & ((depth - then).abs() < _SAME_PLACE * depth)
        assert now.field is not None  # noqa: S101  of a spectrum of values
        assert before.field is not None  # noqa: S101
        field = np.where(same.cpu().numpy(), now.field - before.field - earlier.shift, np.nan).astype(np.float32)
        ends = (-earlier.span, earlier.span)
        return LayerImage(layer, field, None, display_palette("blue red"), ends, now.unit, "change", now.decimals)

    def _error(
        self, layer: Layer, image: Tensor, photograph: Tensor, scale: PixelScale, shown: "_Temperatures"
    ) -> LayerImage:
        """Absolute difference of the image and the nearest photograph, in the unit that the images have."""
        palette = display_palette("inferno")
        if scale.measured_unit is None or scale.range is None:
            field = (image - photograph).abs().mean(dim=-1).cpu().numpy()
            return LayerImage(layer, field, None, palette, (0.0, LARGEST_ERROR), "", "error", 3)
        hidden = photograph.isnan().any(dim=-1)
        seen = shown.of(layer.spectrum, scale.value(pixel_intensity(torch.nan_to_num(photograph), scale)))
        made = shown.of(layer.spectrum, scale.value(pixel_intensity(image, scale)))
        error = (made.values - seen.values).abs()
        field = torch.where(hidden, torch.nan, error).cpu().numpy()
        low, high = self.scene.display_ranges.get(layer.spectrum) or scale.range
        largest = LARGEST_MEASURED_ERROR * (high - low)
        unit = unit_label(scale.measured_unit)
        return LayerImage(
            layer, field, None, palette, (0.0, largest), unit, "error", changed=made.changed, reasons=made.reasons
        )

    def _offset(self, name: str, view: ViewTensors) -> Tensor:
        """Mean opacity offset logit α_s - logit α of the Gaussians that either spectrum sees, [H, W]; NaN: none."""
        model = self.scene.model
        gaussians = model.gaussians(model.set_of(name))
        logits = gaussians.logits_in(name)
        offsets = logits - gaussians.logit_opacities
        how = Rendering(0, False, model.pixel_filter, None)
        largest = torch.maximum(logits, gaussians.logit_opacities)
        image, alpha, _ = render_view(gaussians, offsets[:, None].contiguous(), largest, model.seen(view), how)
        return torch.where(alpha > 1e-3, image / alpha.clamp(min=1e-3), torch.nan)[..., 0]

    @torch.no_grad()
    def how_sure(
        self,
        layer: Layer,
        view: ViewTensors,
        where: NDArray[np.bool_] | None = None,
        values: NDArray[np.floating] | None = None,
    ) -> Sure | None:
        """How sure the values of an image are; None where nobody knows.

        Args:
            where: As of ``Certainty.of_view``.
            values: What the image shows, not recalculated, [H, W]; None: it is rendered.
        """
        certainty = self.scene.certainties.get(layer.spectrum) if layer.kind == "image" else None
        if certainty is None:
            return None
        if values is None:
            values = self.render([layer], view)[layer].field  # not recalculated: images are compared with images
        return None if values is None else certainty.of_view(view, values, where)

    @cached_property
    def features_basis(self) -> FeatureColors:
        """What colours features have; chosen when it is first asked for, and held from then on."""
        gaussians = self.scene.model.gaussians(SHARED)
        return FeatureColors.of(gaussians.expanded(gaussians.features), gaussians.largest_opacities)


class _Temperatures:
    """Recalculated values of one view, whose depths and labels are looked up once."""

    def __init__(self, scene: SceneTemperatures, view: ViewTensors) -> None:
        self.scene, self._view = scene, view
        self._around: dict[str, Surroundings | None] = {}

    def of(self, spectrum: str, values: Tensor) -> Values:
        """Values [H, W] of a spectrum, as they are asked for."""
        if spectrum not in self._around:
            self._around[spectrum] = self.scene.surroundings(spectrum, self._view)
        return self.scene.recalculated(spectrum, values, self._around[spectrum])


def image_layer(
    layer: Layer,
    image: Tensor,
    scale: PixelScale,
    *,
    values: bool,
    valid: Tensor | None = None,
    temperatures: _Temperatures | None = None,
    shown: tuple[float, float] | None = None,
) -> LayerImage:
    """An image of a spectrum: colours of a photograph, else values, in the unit that metrics.json's errors have.

    Args:
        image: Shape [H, W, C].
        valid: Mask [H, W] of the pixels that are there; None: all.
        temperatures: How temperatures are recalculated; None: they are not.
        shown: Values at the palette's ends; None: those that 0 and 1 stand for.
    """
    image, measured = image.clamp(0, 1), scale.measured_unit
    span = (shown or scale.range) if measured is not None and scale.range is not None else (0.0, 1.0)
    unit = "" if measured is None else unit_label(measured)
    quantity = "intensity" if measured is None else "temperature" if unit == "°C" else measured
    decimals = 2 if unit == "°C" else 3
    recalculates = temperatures is not None and temperatures.scene.recalculates(layer.spectrum)
    if not scale.has_intensity or (scale.kind == "color" and not values and not recalculates):
        shown_image = image[..., :3]
        colors = _bytes(shown_image if valid is None else torch.where(valid[..., None], shown_image, 0.0))
        if not scale.has_intensity:
            return LayerImage(layer, None, colors, scale.palette, None)
        return LayerImage(layer, None, colors, scale.palette, span, unit, quantity, decimals)
    intensity = pixel_intensity(image, scale)  # evaluation.held_out.RenderedView.intensity, whose errors are the MAE
    made = Values(intensity if measured is None else scale.value(intensity))
    if temperatures is not None and recalculates:
        made = temperatures.of(layer.spectrum, made.values)
        span = temperatures.scene.shown_scale(layer.spectrum).range or span
    field = made.values if valid is None else torch.where(valid, made.values, torch.nan)
    seen = field.cpu().numpy()
    return LayerImage(
        layer, seen, None, scale.palette, span, unit, quantity, decimals, changed=made.changed, reasons=made.reasons
    )


def _bytes(colors: Tensor) -> Image8:
    """Colours in [0, 1], shape [H, W, 3], as ``rgb_bytes`` has them: a quarter of the bytes leaves the device."""
    return (colors * 255.0).round().to(torch.uint8).cpu().numpy()
