"""thermosplat-export --format html: a page that shows and measures the scene, without a server."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermosplat.cli.exporting.splats import fitted_scene
from thermosplat.cli.recalculating import known_scale

if TYPE_CHECKING:
    from thermosplat.cli.exporting.arguments import ExportArguments
    from thermosplat.evaluation.loaded_run import LoadedRun
    from thermosplat.export.page.written_page import PageLayer
    from thermosplat.export.splats import Splats
    from thermosplat.viewer.viewed_scene import ViewedScene

_MOST_VIEWS = 200
"""Of the capture that the page lists."""


def export_page(arguments: "ExportArguments", loaded: "LoadedRun", folder: Path) -> None:
    """Write ``scene.html``.

    Raises:
        UserError: The arguments, the capture or the format do not allow it.
    """
    import numpy as np

    from thermosplat.export.export_frame import ExportFrame
    from thermosplat.export.formats.splat_formats import check_degree
    from thermosplat.export.page.written_page import PageScene, page_of
    from thermosplat.runs.atomic_writes import write_text
    from thermosplat.thermal.radiometry import FLIR_IRON
    from thermosplat.viewer.viewed_scene import ViewedScene, frame_bookmark

    capture, placement = loaded.capture(arguments.data), loaded.model.placement
    viewed = ViewedScene("", loaded.model, loaded.sh_degree, dict(loaded.scales), loaded.device, capture)
    scene, _ = fitted_scene(arguments, loaded, ExportFrame(placement), colors="scalar")
    for name, (splats, _) in scene.items():
        check_degree("html", name, splats)
    layers = [_layer(loaded, viewed, name, splats) for name, (splats, _) in scene.items()]
    measured = next((layer.key for layer in layers if layer.is_value), layers[0].key)
    frames = [frame for frame in viewed.frames if frame.views]
    frames = frames[:: -(-len(frames) // _MOST_VIEWS)]
    views = []
    for frame in frames:
        seen = frame_bookmark(frame, measured if measured in frame.views else next(iter(frame.views)))
        viewmat = placement.viewmat_to_world(seen.viewmat)
        viewmat[:3, 3] += viewmat[:3, :3] @ placement.origin
        views.append({"name": seen.name, "viewmat": viewmat.tolist(), "fov": seen.fov_y})
    x, y, z = (placement.unit * viewed.focus).tolist()
    marks, metres = _marks(arguments, loaded, viewed)
    about = PageScene(
        title=capture.root.resolve().name,
        views=views,
        start=len(views) // 2,
        up=tuple(viewed.up.tolist()),
        focus=(x, y, z),
        spacing=placement.unit * viewed.frame_spacing,
        origin=placement.origin,
        metres=metres,
        marks=[{**one, "points": (np.array(one["points"]) - placement.origin).tolist()} for one in marks],
    )
    scale = loaded.scales[measured]
    path = folder / "scene.html"
    write_text(path, page_of(about, layers, FLIR_IRON if scale.kind == "photograph" else scale.palette))
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB; open it in a browser.")


def _layer(loaded: "LoadedRun", viewed: "ViewedScene", name: str, splats: "Splats") -> "PageLayer":
    from thermosplat.export.page.written_page import PageLayer
    from thermosplat.export.splat_fit.exact_images import ExactImages
    from thermosplat.spectra import CELSIUS, label, unit_label

    scale = loaded.scales[name]
    red, green, blue = ExactImages(loaded.model, name, scale, loaded.sh_degree, "scalar").background.tolist()
    layer = PageLayer(name, label(name), splats, scale.kind != "photograph", (red, green, blue))
    if scale.measured_unit is None or scale.range is None:
        return layer
    shown = viewed.display_ranges.get(name) or scale.range
    decimals = 2 if scale.measured_unit == CELSIUS else 3
    unit = unit_label(scale.measured_unit)
    return dataclasses.replace(layer, range=scale.range, shown=shown, unit=unit, decimals=decimals)


def _marks(
    arguments: "ExportArguments", loaded: "LoadedRun", viewed: "ViewedScene"
) -> tuple[list[dict[str, Any]], float | None]:
    """Findings of the last report and measurements of the viewer, points in the world; and metres per world unit."""
    from thermosplat.reporting.findings_file import read_findings
    from thermosplat.thermography.measurement_book import Pages
    from thermosplat.thermography.measurements_file import FOLDER, MEASUREMENTS, read_book
    from thermosplat.thermography.shapes import AREAS
    from thermosplat.viewer.layers import LayerRenderer
    from thermosplat.viewer.measuring import Measurer

    root = loaded.directory.path
    marks: list[dict[str, Any]] = [
        {"kind": "finding", "name": one.name, "text": one.text, "points": [one.place]} for one in read_findings(root)
    ]
    kept = root / FOLDER / MEASUREMENTS
    pages, definitions = read_book(kept) if kept.is_file() else (Pages(), [])
    metres = pages.metres_per_unit or known_scale(viewed.capture)
    for one in Measurer(LayerRenderer(viewed)).again(pages, definitions).measurements:
        points = [list(point) for point in one.numbers.points if point is not None]
        if points:
            shape = one.definition.shape
            text = ", ".join(filter(None, (one.extent_text(metres), one.text)))
            marks.append(
                {"kind": "area" if shape in AREAS else shape, "name": one.name, "text": text, "points": points}
            )
    return marks, metres
