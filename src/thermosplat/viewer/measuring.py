"""Measuring without a browser: what the viewer, thermosplat-measure and Python have in common.

run = load_run("results/shed")
scene, _, _ = open_scene("results/shed")
pages, definitions = read_book(Path("results/shed/measurements.json"))
measured = Measurer(LayerRenderer(scene)).again(pages, definitions)
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_tensors import ViewTensors, without_pixels
from thermosplat.errors import UserError
from thermosplat.spectra import CELSIUS
from thermosplat.thermography.certainty import Sure
from thermosplat.thermography.hot_regions import HotPixels, Region, find_regions
from thermosplat.thermography.measurement_book import Pages
from thermosplat.thermography.measurements import Definition, Measurement, Numbers, Seen, Standpoint, measure
from thermosplat.thermography.reprojection import resized, scene_points
from thermosplat.thermography.scene_temperatures import SceneTemperatures
from thermosplat.viewer.layers import Layer, LayerImage, LayerRenderer, available_layers

REGION_WIDTH = 200
"""Width [px] at which views are searched for regions."""
_PIXELS = 2
"""Of such a view that a cell of the grid is wide: neighbouring ones lie in neighbouring cells."""


@dataclass(frozen=True, eq=False)
class SearchedView:
    """A view of the capture in which regions are looked for."""

    frame: Frame
    view: ViewTensors
    values: NDArray[np.float64]
    """[H, W], in the unit of the spectrum."""
    depth: NDArray[np.float64]
    """z-depth [world units], [H, W]; 0 where nothing is."""
    points: NDArray[np.float64]
    """What its pixels see, in the world, [H, W, 3]."""
    is_as_taken: bool = False
    """Whether the values are those of the capture, none of them recalculated."""

    @property
    def there(self) -> NDArray[np.bool_]:
        """Where something with a value is, [H, W]."""
        return (self.depth > 0) & np.isfinite(self.values)

    @property
    def distance(self) -> float:
        """Median depth [world units]; 0 where nothing is."""
        return float(np.median(self.depth[self.depth > 0])) if (self.depth > 0).any() else 0.0

    def hot(self, beyond: NDArray[np.bool_]) -> HotPixels:
        """Some of its pixels [H, W] as regions are made of them."""
        areas = self.depth[beyond] ** 2 / float(self.view.K[0, 0] * self.view.K[1, 1])
        return HotPixels(self.points[beyond], self.values[beyond], areas)


def grid_cell(views: Sequence[SearchedView]) -> float:
    """Side of the cells that connect regions of views [world units]."""
    return max(_PIXELS * float(np.median([view.distance / float(view.view.K[0, 0]) for view in views])), 1e-9)


class Measurer:
    """Measures a scene.

    Args:
        temperatures: How temperatures are recalculated for the whole scene; None: as the scene says.
    """

    def __init__(self, renderer: LayerRenderer, temperatures: SceneTemperatures | None = None) -> None:
        self.renderer = renderer
        self.scene = renderer.scene
        self.temperatures = temperatures or renderer.scene.temperatures

    def seen(self, definition: Definition) -> Seen:
        """The layer of a definition, rendered from its standpoint.

        Raises:
            UserError: The scene has no such layer.
        """
        layer = self.layer(definition)
        depth = Layer("depth", definition.spectrum)
        view = self.tensors(definition.standpoint)
        images = self.renderer.render([layer, depth], view, temperatures=self.asked(definition))
        return seen_layer(images[layer], images[depth], self.asked(definition), self.renderer.how_sure(layer, view))

    def layer(self, definition: Definition) -> Layer:
        """The layer of a definition.

        Raises:
            UserError: The scene has no such layer.
        """
        layers = available_layers(self.scene)
        wanted = (definition.layer, definition.spectrum)
        found = next((layer for layer in layers if (layer.kind, layer.spectrum) == wanted), None)
        if found is None:
            raise UserError(
                f"{definition.name} measures {' of '.join(wanted)}, which the scene does not have.",
                f"It has {', '.join(dict.fromkeys(f'{layer.kind} of {layer.spectrum}' for layer in layers))}.",
            )
        return found

    def asked(self, definition: Definition) -> SceneTemperatures:
        """How temperatures are recalculated where a definition has settings of its own."""
        made = self.temperatures
        if not definition.settings or made.recalculation is None:
            return made
        own: dict[str, Any] = dict(definition.settings)
        return made.asking(TemperatureSettings(**own).over(made.recalculation.settings))

    def measure(self, definition: Definition) -> Numbers | None:
        """The numbers of a definition; None where no pixel has a value."""
        return measure(definition, self.seen(definition))

    def again(self, pages: Pages, definitions: Sequence[Definition]) -> Pages:
        """Pages with the numbers that the scene has now; what has none any more is left out."""
        measured = [(one, self.measure(one)) for one in definitions]
        made = tuple(Measurement(one, numbers) for one, numbers in measured if numbers is not None)
        return replace(pages, measurements=made)

    def tensors(self, standpoint: Standpoint) -> ViewTensors:
        """A standpoint as it is rendered."""
        viewmat = self.scene.model.placement.viewmat_to_scene(standpoint.viewmat)
        return self.scene.view(viewmat, standpoint.fov_y, standpoint.width, standpoint.height)

    @torch.no_grad()
    def regions(self, spectrum: str, threshold: float, *, colder: bool = False) -> list[tuple[Region, str]]:
        """Parts of the whole scene above a threshold, with the name of the frame that sees each best.

        Raises:
            UserError: There are no photographs to search by.
        """
        views = list(self.searched(spectrum))
        found = [one.hot((one.values < threshold if colder else one.values > threshold) & one.there) for one in views]
        regions = find_regions(found, grid_cell(views), colder=colder)
        return [(region, views[region.best_view].frame.name) for region in regions]

    @torch.no_grad()
    def searched(self, spectrum: str, width: int = REGION_WIDTH, every: int = 1) -> Iterator["SearchedView"]:
        """The views of the capture, rendered as small as regions are looked for in them.

        Args:
            width: Of the pictures [px]; those of the capture are not enlarged.
            every: Each which view is taken, >= 1.

        Raises:
            UserError: There are no photographs to search by.
        """
        frames = [frame for frame in self.scene.frames if spectrum in frame.views]
        if not frames:
            raise UserError(
                "Regions are looked for in the views of the capture, which is not at hand.", "--data FOLDER says where."
            )
        layer, model = Layer("image", spectrum), self.scene.model
        for frame in frames[::every]:
            taken = without_pixels(frame.views[spectrum], self.scene.device).as_pinhole()
            factor = min(1.0, width / taken.width)
            view = resized(taken, max(1, round(factor * taken.width)), max(1, round(factor * taken.height)))
            image = self.renderer.render([layer], view, temperatures=self.temperatures)[layer]
            depth = model.render_depth(spectrum, view)
            assert image.field is not None  # noqa: S101  of a spectrum of values
            z = depth.cpu().numpy().astype(np.float64) * model.placement.unit
            points = model.placement.to_world(scene_points(view, depth).cpu().numpy())
            yield SearchedView(frame, view, image.field.astype(np.float64), z, points, image.changed is None)

    def spectrum_of_values(self) -> str:
        """The measured spectrum; where nothing is measured, the first that has intensities.

        Raises:
            UserError: There are colours alone.
        """
        scales = self.scene.scales
        if all(scales[name].measured_unit is None for name in self.scene.model.spectra):
            for name in self.scene.model.spectra:
                if scales[name].kind != "photograph":
                    return name
        return self.measured_spectrum()

    def measured_spectrum(self) -> str:
        """The spectrum whose regions are looked for: the first with temperatures, else with values.

        Raises:
            UserError: Nothing is measured in the scene.
        """
        units = {name: self.scene.scales[name].measured_unit for name in self.scene.model.spectra}
        for wanted in (lambda unit: unit == CELSIUS, lambda unit: unit is not None):
            for name, unit in units.items():
                if wanted(unit):
                    return name
        raise UserError("Nothing is measured in this scene: no spectrum has a unit.")


def seen_layer(
    image: LayerImage, depth: LayerImage | None, temperatures: SceneTemperatures, sure: Sure | None = None
) -> Seen:
    """A layer as measurements see it.

    Args:
        depth: The depth of its spectrum from the same view.

    Raises:
        UserError: It is a layer of colours.
    """
    if image.field is None:
        raise UserError(
            f"{image.layer.label} has colours, and nothing can be measured in it.", "Choose a layer of values."
        )
    return Seen(
        values=image.field,
        depth=None if depth is None else depth.field,
        quantity=image.quantity,
        unit=image.unit,
        decimals=image.decimals,
        changed=image.changed,
        recalculated="" if image.changed is None else temperatures.text,
        reasons=image.reasons,
        sure=sure,
    )
