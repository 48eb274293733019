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
from thermosplat.viewer.photographs import Photographs
from thermosplat.viewer.viewed_scene import ViewedScene

_LABELS = {
    "image": "{}",
    "depth": "depth, {}",
    "opacity": "opacity, {}",
    "offset": "opacity offset, {}",
    "features": "features, {}",
    "error": "error, {}",
    "photograph": "photograph, {}",
}
_OTHERS = ("depth", "offset", "photograph")
"""Layers that a render of the spectrum's image does not have."""
_SPREAD = 3.0
"""Standard deviations of the features' principal components from black to full colour, to either side."""


@dataclass(frozen=True)
class Layer:
    """One thing to look at, in one spectrum."""

    kind: str
    """What it is: one of those that every scene has, or of the spectrum's ``Formation.layers``."""
    spectrum: str
    """In which spectrum."""

    @property
    def label(self) -> str:
        """Its name on the page."""
        return _LABELS.get(self.kind, f"{self.kind}, {{}}").format(label(self.spectrum))


@dataclass(frozen=True, eq=False)
class LayerImage:
    """A layer as it was rendered from one view."""

    layer: Layer
    """Which one."""
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
    layers += [Layer("depth", name) for name in spectra]
    layers += [Layer("opacity", name) for name in spectra]
    for name in spectra:
        if name in model.gaussians(model.set_of(name)).second_opacities:
            layers.append(Layer("offset", name))
    layers += [Layer("features", name) for name in spectra if model.formations[name].takes_features]
    layers += [Layer(kind, name) for name in spectra for kind in model.formations[name].layers]
    photographed = [name for name in spectra if any(name in frame.views for frame in scene.frames)]
    layers += [Layer("error", name) for name in photographed]
    layers += [Layer("photograph", name) for name in photographed]
    return layers


class LayerRenderer:
    """Renders layers of a scene.

    Args:
        scene: The scene.
    """

    def __init__(self, scene: ViewedScene) -> None:
        self.scene = scene
        self.photographs = Photographs(scene)

    @torch.no_grad()
    def render(self, layers: Iterable[Layer], view: ViewTensors, *, values: bool = True) -> dict[Layer, LayerImage]:
        """Render layers from one view.

        Args:
            layers: Which ones.
            view: Camera and pose, on the model's device.
            values: Also the values behind pseudo-colours, which takes a while; without, such a layer has its colours.

        Returns:
            The layers.
        """
        scene, wanted = self.scene, list(dict.fromkeys(layers))
        from_model = {layer.spectrum for layer in wanted if layer.kind not in _OTHERS}
        rendered = RenderedFrame()
        if from_model:
            rendered = scene.model.render(dict.fromkeys(from_model, view), sh_degree=scene.sh_degree)
        return {layer: self._layer(layer, view, rendered, values) for layer in wanted}

    def _layer(self, layer: Layer, view: ViewTensors, rendered: RenderedFrame, values: bool) -> LayerImage:
        name, scale = layer.spectrum, self.scene.scales[layer.spectrum]
        if layer.kind == "image":
            return image_layer(layer, rendered.images[name], scale, values=values)
        if layer.kind == "depth":
            model = self.scene.model
            depth = model.placement.unit * model.render_depth(name, view)
            field = torch.where(depth > 0, depth, torch.nan).cpu().numpy()
            return LayerImage(layer, field, None, display_palette("turbo"), None, "world units", "depth", 3)
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
            return LayerImage(layer, field, None, display_palette("white hot"), (0.0, 1.0), "", layer.kind, 3)
        photograph = self.photographs.nearest(name, view)
        if layer.kind == "photograph":
            return image_layer(layer, torch.nan_to_num(photograph.image), scale, values=values, valid=photograph.valid)
        return self._error(layer, rendered.images[name].clamp(0, 1), photograph.image, scale)

    def _error(self, layer: Layer, image: Tensor, photograph: Tensor, scale: PixelScale) -> LayerImage:
        """Absolute difference of the image and the nearest photograph, in the unit that the images have."""
        palette = display_palette("inferno")
        if scale.measured_unit is None or scale.range is None:
            field = (image - photograph).abs().mean(dim=-1).cpu().numpy()
            return LayerImage(layer, field, None, palette, (0.0, LARGEST_ERROR), "", "error", 3)
        hidden = photograph.isnan().any(dim=-1)
        seen = pixel_intensity(torch.nan_to_num(photograph), scale)
        error = (scale.value(pixel_intensity(image, scale)) - scale.value(seen)).abs()
        field = torch.where(hidden, torch.nan, error).cpu().numpy()
        largest = LARGEST_MEASURED_ERROR * (scale.range[1] - scale.range[0])
        return LayerImage(layer, field, None, palette, (0.0, largest), unit_label(scale.measured_unit), "error")

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

    @cached_property
    def features_basis(self) -> "FeatureColors":
        """What colours features have; chosen when it is first asked for, and held from then on."""
        gaussians = self.scene.model.gaussians(SHARED)
        return FeatureColors.of(gaussians.expanded(gaussians.features), gaussians.largest_opacities)


def image_layer(
    layer: Layer, image: Tensor, scale: PixelScale, *, values: bool, valid: Tensor | None = None
) -> LayerImage:
    """An image of a spectrum: colours of a photograph, else values, in the unit that metrics.json's errors have.

    Args:
        layer: Which layer it is.
        image: Shape [H, W, C].
        scale: What its pixel values mean.
        values: As of ``LayerRenderer.render``.
        valid: Mask [H, W] of the pixels that are there; None: all.
    """
    image, measured = image.clamp(0, 1), scale.measured_unit
    span = scale.range if measured is not None and scale.range is not None else (0.0, 1.0)
    unit = "" if measured is None else unit_label(measured)
    quantity = "intensity" if measured is None else "temperature" if unit == "°C" else measured
    decimals = 2 if unit == "°C" else 3
    if scale.kind == "photograph" or (scale.kind == "color" and not values):
        colors = _bytes(image if valid is None else torch.where(valid[..., None], image, 0.0))
        if scale.kind == "photograph":
            return LayerImage(layer, None, colors, scale.palette, None)
        return LayerImage(layer, None, colors, scale.palette, span, unit, quantity, decimals)
    intensity = pixel_intensity(image, scale)  # evaluation.held_out.RenderedView.intensity, whose errors are the MAE
    field = intensity if measured is None else scale.value(intensity)
    if valid is not None:
        field = torch.where(valid, field, torch.nan)
    return LayerImage(layer, field.cpu().numpy(), None, scale.palette, span, unit, quantity, decimals)


def _bytes(colors: Tensor) -> Image8:
    """Colours in [0, 1], shape [H, W, 3], as ``rgb_bytes`` has them: a quarter of the bytes leaves the device."""
    return (colors * 255.0).round().to(torch.uint8).cpu().numpy()


@dataclass(frozen=True)
class FeatureColors:
    """Three principal components of the Gaussians' features as red, green and blue."""

    mean: Tensor
    """[d]."""
    components: Tensor
    """Directions, each divided by the standard deviation along it, [d, 3]."""

    @classmethod
    def of(cls, features: Tensor, weights: Tensor) -> "FeatureColors":
        """The components of features [N, d], each of which counts by its weight [N]."""
        share = (weights / weights.sum().clamp(min=1e-12))[:, None]
        mean = (share * features).sum(dim=0)
        centred = features - mean
        values, vectors = torch.linalg.eigh((share * centred).T @ centred)  # rising
        chosen = vectors[:, -3:].flip(-1)
        chosen = chosen * torch.where(chosen.sum(dim=0) < 0, -1.0, 1.0)  # either sign is as good: one that stays
        scaled = chosen / values[-3:].flip(-1).clamp(min=1e-12).sqrt()
        padded = torch.zeros(features.shape[1], 3, device=features.device, dtype=features.dtype)
        padded[:, : scaled.shape[1]] = scaled
        return cls(mean, padded)

    def colors(self, blended: Tensor, alpha: Tensor) -> Tensor:
        """Colours [H, W, 3] of features [H, W, d] that were blended to opacities [H, W, 1]; black where nothing is."""
        there = blended / alpha.clamp(min=1e-3)
        return (0.5 + (there - self.mean) @ self.components / (2 * _SPREAD)).clamp(0, 1) * alpha
