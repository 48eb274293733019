"""Methods by the regions that are hard for one spectrum or the other, where captures have ground truth."""

from thermosplat.evaluation.labelled_regions import REGIONS, Column, region_columns
from thermosplat.method_matrix.results import Results
from thermosplat.method_matrix.tables.entries import entry, known, means_over_scenes
from thermosplat.method_matrix.tables.table import Table


def region_table(results: Results) -> Table | None:
    """A row for each region, scene and method; the mean over the scenes where a method has all that have the region.

    Returns:
        None where no cell has regions.
    """
    columns = region_columns([numbers for cell in results.cells.values() for numbers in (cell.regions or {}).values()])
    rows: list[tuple[str, ...]] = []
    for region in REGIONS:
        having = {cell.scene for cell in results.cells.values() if region in (cell.regions or {})}
        scenes = [scene for scene in results.scenes() if scene in having]
        for scene in scenes:
            for method in results.methods():
                numbers = [_values(results, scene, method, region, column) for column in columns]
                if any(numbers):
                    rows.append((region, scene, method, *map(_entry, numbers, columns)))
        for method in results.methods() if len(scenes) > 1 else []:
            means = [
                means_over_scenes([_values(results, s, method, region, column) for s in scenes]) for column in columns
            ]
            if any(means):
                rows.append((region, "mean", method, *map(_entry, means, columns)))
    if not rows:
        return None
    title = (
        "Held-out views by region. PSNR and MAE over all its pixels; depth errors are medians over them, in the "
        "scene's unit and relative to the true depth. On own surface: share of the pixels whose depth is nearer to "
        "what the spectrum sees than to what another one sees, where the two differ."
    )
    headings = [column.heading for column in columns]
    return Table("regions", title, ("region", "scene", "method", *headings), tuple(rows), labels=3)


def _values(results: Results, scene: str, method: str, region: str, column: Column) -> list[float]:
    """A number of every seed that has it."""
    cells = [cell.regions[region] for cell in results.of(scene, method) if cell.regions and region in cell.regions]
    return known(map(column.value, cells))


def _entry(values: list[float], column: Column) -> str:
    return entry(values, column.form)
