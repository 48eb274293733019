"""What a viewer wants to see, and the picture that shows it."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from thermosplat.novel_views.bookmarks import Bookmark
from thermosplat.pictures.image_display import Image8
from thermosplat.viewer.display import Comparison
from thermosplat.viewer.layers import Layer, LayerImage


@dataclass(frozen=True)
class Wish:
    """What is to be seen; the place to see it from is given apart."""

    first: Layer
    """The layer that is looked at and measured."""
    second: Layer
    """The one that it is compared with."""
    comparison: Comparison = "off"
    share: float = 0.5
    """Of the width that the first layer has in a wipe; of the second layer in a blend."""
    over: bool = False
    """The nearest photograph lies over the picture."""

    @property
    def layers(self) -> list[Layer]:
        """The layers that have to be rendered."""
        shown = [self.first] if self.comparison == "off" else [self.first, self.second]
        return [*shown, Layer("photograph", self.first.spectrum)] if self.over else shown


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture that was made, with the values behind it."""

    wish: Wish
    view: Bookmark
    layers: dict[Layer, LayerImage]
    picture: Image8
    """8-bit RGB, shape [H, W, 3]."""
    full: bool
    """Whether it is the picture at rest, whose values may be read."""

    def layer_at(self, x: float) -> LayerImage | None:
        """What is seen at a share of the width."""
        wish = self.wish
        if wish.over:
            return self.layers.get(Layer("photograph", wish.first.spectrum))
        return self.layers.get(wish.second if wish.comparison == "wipe" and x > wish.share else wish.first)


def start_wish(layers: Sequence[Layer], measured: Collection[str] = ()) -> Wish:
    """What is seen first: an image with temperatures, ready to be compared with another spectrum's.

    Args:
        layers: Those that there are (``available_layers``).
        measured: Spectra that have temperatures; without any the first spectrum's image is seen.
    """
    images = [layer for layer in layers if layer.kind == "image"] or list(layers[:1])
    first = next((layer for layer in images if layer.spectrum in measured), images[0])
    before = [layer for layer in layers if layer == Layer("before", first.spectrum)]
    return Wish(first, next((layer for layer in (*before, *images) if layer != first), first))


def layer_labels(layers: Sequence[Layer]) -> dict[str, Layer]:
    """Layers by their names on the page."""
    return {layer.label: layer for layer in layers}
