"""Arguments of thermosplat-export."""

from dataclasses import dataclass
from typing import Literal

from thermosplat.cli.run_arguments import RunOnCaptureArguments, SpectraArguments
from thermosplat.config.temperature_settings import TemperatureSettings


@dataclass(frozen=True)
class ExportArguments(TemperatureSettings, SpectraArguments, RunOnCaptureArguments):
    """Write a trained run for other programs, one file for each spectrum: splat_rgb.ply, splat_thermal.ply, ..."""

    format: Literal[
        "ply", "compressed-ply", "spz", "sog", "glb", "usd", "points", "las", "mesh", "orthomosaic", "html"
    ] = "ply"
    """Splats: PLY of the original 3D Gaussian Splatting; PlayCanvas's compressed PLY and SOG; Niantic's SPZ; glTF with
    KHR_gaussian_splatting; OpenUSD (needs usd-core). docs/exports.md says which program opens which. Surfaces
    from rendered depth with measured values: points and mesh as PLY (mesh needs scikit-image), points as LAS (needs
    laspy). A map from above: orthomosaic, a GeoTIFF of colours or of measured values (needs rasterio). html: one
    page that shows and measures the scene in a browser, without a server."""
    output: str | None = None
    """Folder for the files. None: in the result folder, ply/ for PLY and exports/ for the others."""
    fit_passes: int | None = None
    """How long the splats are fitted to what the decoders show: so many steps for each training view. 0: each Gaussian
    stays and gets the colour that its own features decode to. None: 30 on a CPU, 60 on a GPU. Scenes without decoders
    need no fit."""
    colors: Literal["palette", "scalar"] = "palette"
    """Spectra that are no photographs: in the colours of their palette, or their intensity from black to white."""
    compact: bool = False
    """PLY: leave out spherical harmonics that are zero everywhere. The original viewer wants all of them; many others
    do not."""
    values: bool = False
    """PLY: also write what each Gaussian measures, as scalar_<spectrum>_<unit>, which CloudCompare shows as a scalar
    field. Some viewers want the original properties and no more."""
    points: int = 1_000_000
    """Points, LAS: at most so many."""
    voxel: float | None = None
    """Mesh: side of a voxel [world units]. None: 1/256 of the scene's longest side."""
    gsd: float | None = None
    """Map: side of a pixel on the ground, in metres where the capture lies on the Earth, else in world units. None: a
    thousandth of the map's longer side."""
    extent: tuple[float, float, float, float] | None = None
    """Map: west, south, east and north of what it shows. None: what the capture saw."""
    top: float | None = None
    """Map: height from which it is seen; what lies above is left out. None: the height of the highest camera."""
    up: tuple[float, float, float] | None = None
    """Map without GPS: what is up in the world. None: found by the cameras."""
