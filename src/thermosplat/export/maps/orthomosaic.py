"""Maps of a trained scene: each spectrum rendered from above by parallel rays, exactly, decoders included."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.errors import UserError
from thermosplat.export.maps.geotiff import write_geotiff
from thermosplat.export.maps.map_frame import MapFrame, camera_centers, map_extent
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermography.scene_temperatures import SceneTemperatures

MOST_PIXELS = 1 << 28
"""Of a map: 1 GiB per band."""
TILE = 2048
"""Side of what is rendered at once [px]."""


@dataclass(frozen=True)
class MapGrid:
    """The pixels of a map."""

    frame: MapFrame
    west: float
    """Left edge."""
    north: float
    """Upper edge."""
    pixel: float
    """Side of a pixel, the ground sampling distance [map units]."""
    width: int
    height: int
    top: float
    """Height [map units] from which the map is seen; what lies above is left out."""

    @classmethod
    def covering(
        cls, frame: MapFrame, extent: tuple[float, float, float, float], pixel: float, top: float
    ) -> "MapGrid":
        """The grid of an extent.

        Args:
            extent: West, south, east, north.
            top: Height from which the map is seen.

        Raises:
            UserError: The extent is empty, or has too many pixels.
        """
        west, south, east, north = extent
        if not (np.isfinite(extent).all() and west < east and south < north):
            found = " ".join(f"{x:g}" for x in extent)
            raise UserError(f"--extent must be WEST SOUTH EAST NORTH, rising, found {found}.")
        if not (np.isfinite(pixel) and pixel > 0):
            raise UserError(f"--gsd must be greater than 0, found {pixel:g}.")
        columns, rows = (max(1.0, span / pixel) for span in (east - west, north - south))
        if columns * rows > MOST_PIXELS:
            fitting = ((east - west) * (north - south) / MOST_PIXELS) ** 0.5
            raise UserError(
                f"A map of {columns:,.0f} x {rows:,.0f} pixels is too large (more than {MOST_PIXELS:,}).",
                f"Give a larger --gsd, at least {fitting:.3g}, or a smaller --extent.",
            )
        width, height = round(columns), round(rows)
        return cls(frame, west, north, pixel, width, height, top)

    @classmethod
    def over(
        cls,
        frame: MapFrame,
        capture: Capture,
        leading: str,
        *,
        extent: tuple[float, float, float, float] | None = None,
        pixel: float | None = None,
        pixels: int = 1000,
        top: float | None = None,
    ) -> "MapGrid":
        """The grid of what a capture saw.

        Args:
            extent: As of ``covering``; None: what the cameras saw.
            pixel: As of ``covering``; None: so that the longer side has ``pixels``.
            pixels: Along the longer side.
            top: As of ``covering``; None: the highest camera.

        Raises:
            UserError: As of ``covering``; or the capture has no training views of the spectrum.
        """
        west, south, east, north = extent = extent or map_extent(frame, capture)
        if top is None:
            top = float(frame.to_map(camera_centers(capture, leading)[0])[:, 2].max())
        return cls.covering(frame, extent, max(east - west, north - south) / pixels if pixel is None else pixel, top)

    def view(self, left: int, upper: int, width: int, height: int, device: torch.device | str) -> ViewTensors:
        """The camera of a part of the map: parallel rays downwards.

        Colours that change with the viewing direction are those seen from above the middle of the whole map.

        Args:
            left: First column of the part.
            upper: First row.
            width: Columns.
            height: Rows.
        """
        middle = np.array(
            [self.west + self.width * self.pixel / 2, self.north - self.height * self.pixel / 2, self.top]
        )
        rotation = np.diag([1.0, -1.0, -1.0]) @ self.frame.rotation  # right is east, down is south, forward is down
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ self.frame.to_scene(middle)
        focal = self.frame.scale / self.pixel  # [px per unit of the scene]
        K = np.array([[focal, 0, self.width / 2 - left], [0, focal, self.height / 2 - upper], [0, 0, 1]])
        return ViewTensors(
            viewmat=torch.as_tensor(viewmat, dtype=torch.float32, device=device),
            K=torch.as_tensor(K, dtype=torch.float32, device=device),
            width=width,
            height=height,
            orthographic=True,
        )

    def tiles(self) -> Iterator[tuple[int, int, int, int]]:
        """Left column, upper row, columns and rows of the parts that are rendered one after the other."""
        for upper in range(0, self.height, TILE):
            for left in range(0, self.width, TILE):
                yield left, upper, min(TILE, self.width - left), min(TILE, self.height - upper)


@torch.no_grad()
def render_map(
    model: SceneModel,
    name: str,
    scale: PixelScale,
    grid: MapGrid,
    *,
    sh_degree: int,
    temperatures: SceneTemperatures | None = None,
) -> NDArray[np.float32]:
    """A spectrum from above.

    Args:
        temperatures: How temperatures are recalculated; None: they are not. The path through the air is then that from
            the map's top.

    Returns:
        [B, H, W]: colours in [0, 1] of a photograph, else one band: measured values, or intensities in [0, 1] where
        nothing is measured. NaN where Gaussians cover less than 90% in every spectrum. Recalculated temperatures have a
        second band, 1 where they were.
    """
    recalculated = temperatures is not None and temperatures.recalculates(name)
    bands = 3 if not scale.has_intensity else 2 if recalculated else 1
    picture = np.full((bands, grid.height, grid.width), np.nan, np.float32)
    for left, upper, width, height in grid.tiles():
        view = grid.view(left, upper, width, height, model.background.device)
        rendered = model.render(dict.fromkeys(model.spectra, view), sh_degree=sh_degree)
        image = rendered.images[name].clamp(0, 1)
        if temperatures is not None and recalculated:
            made = temperatures.of_image(name, image, view)
            changed = torch.zeros_like(made.values) if made.changed is None else torch.as_tensor(made.changed)
            image = torch.stack([made.values, changed.to(made.values)], dim=-1)
        elif bands == 1:
            intensity = pixel_intensity(image, scale)
            image = (intensity if scale.measured_unit is None else scale.value(intensity))[..., None]
        image = image[..., :bands]  # of a stack the first
        seen = rendered.covered()[..., None].to(image.device)
        part = torch.where(seen, image, torch.nan).permute(2, 0, 1).cpu().numpy()
        picture[:, upper : upper + height, left : left + width] = part
    return picture


def write_map(
    path: Path, picture: NDArray[np.float32], name: str, scale: PixelScale, grid: MapGrid, *, recalculated: str = ""
) -> None:
    """Write what :func:`render_map` rendered as GeoTIFF.

    Args:
        path: The file, ``*.tif``.
        picture: [B, H, W].
        recalculated: How temperatures were recalculated (``SceneTemperatures.text``); "": they were not.

    Raises:
        UserError: rasterio is not installed.
    """
    unit = scale.measured_unit
    bands = [f"{name} {unit or 'intensity'}", "recalculated (1: yes)"][: len(picture)]
    tags = {"SOFTWARE": "thermosplat", "SPECTRUM": name, "FRAME": grid.frame.note}
    write_geotiff(
        path,
        picture,
        west=grid.west,
        north=grid.north,
        pixel=grid.pixel,
        crs=grid.frame.crs,
        names=["red", "green", "blue"] if len(picture) == 3 else bands,
        unit=unit,
        tags={**tags, **({"TEMPERATURES": recalculated} if recalculated else {})},
    )
