"""thermosplat-export --format orthomosaic: maps of each spectrum as GeoTIFF."""

from pathlib import Path
from typing import TYPE_CHECKING

from thermosplat.cli.recalculating import asked_temperatures

if TYPE_CHECKING:
    from thermosplat.cli.exporting.arguments import ExportArguments
    from thermosplat.evaluation.loaded_run import LoadedRun

PIXELS_BY_DEFAULT = 1000
"""Along the longer side of a map without --gsd."""


def export_map(arguments: "ExportArguments", loaded: "LoadedRun", folder: Path) -> None:
    """Write ``orthomosaic_<spectrum>.tif`` for the chosen spectra, all on one grid.

    Raises:
        UserError: The capture cannot be read, an argument is impossible, or rasterio is missing.
    """
    import numpy as np

    from thermosplat.export.export_frame import ExportFrame
    from thermosplat.export.maps.georeference import georeferenced_frame, located_frame
    from thermosplat.export.maps.geotiff import rasterio_module
    from thermosplat.export.maps.map_frame import leading_spectrum, local_frame
    from thermosplat.export.maps.orthomosaic import MapGrid, render_map, write_map

    rasterio_module()  # to say that it is missing before anything is rendered
    capture = loaded.capture(arguments.data)
    for note in capture.notes:
        print(note)
    temperatures = asked_temperatures(arguments, loaded, capture)
    names = arguments.chosen(list(loaded.model.spectra))
    leading = leading_spectrum(capture)
    geo, frame = loaded.geo or capture.geo, None
    if arguments.up is None:
        frame = georeferenced_frame(capture, leading) if geo is None else located_frame(geo, capture.placement)
    if frame is None:
        frame = local_frame(capture, leading, arguments.up)
        print(f"The map is in local coordinates, in world units. {frame.note}")
    else:
        print(f"The map is georeferenced. {frame.note}")
    grid = MapGrid.over(
        frame,
        capture,
        leading,
        extent=arguments.extent,
        pixel=arguments.gsd,
        pixels=PIXELS_BY_DEFAULT,
        top=arguments.top,
    )
    for name in names:
        scale = loaded.scales[name]
        picture = render_map(loaded.model, name, scale, grid, sh_degree=loaded.sh_degree, temperatures=temperatures)
        path = folder / f"orthomosaic_{name}.tif"
        recalculated = temperatures.text if temperatures.recalculates(name) else ""
        write_map(path, picture, name, scale, grid, recalculated=recalculated)
        unit = "colours" if len(picture) == 3 else scale.measured_unit or "intensity"
        unit += ", recalculated" if recalculated else ""
        covered = np.isfinite(picture[0]).mean()
        print(f"{path}: {grid.width:,} x {grid.height:,} pixels of {grid.pixel:.4g}, {unit}, {covered:.0%} covered")
    if geo is not None and arguments.up is None:
        ExportFrame(capture.placement, geo).write(folder)
