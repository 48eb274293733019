"""thermosplat-export --format points, --format mesh: the surfaces that the spectra see."""

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from thermosplat.cli.recalculating import asked_temperatures

if TYPE_CHECKING:
    from thermosplat.cli.exporting.arguments import ExportArguments
    from thermosplat.evaluation.loaded_run import LoadedRun

VOXELS_BY_DEFAULT = 256
"""Along the longest side of a mesh without --voxel."""


def export_surface(arguments: "ExportArguments", loaded: "LoadedRun", folder: Path) -> None:
    """Write ``points_<spectrum>.ply`` or ``mesh_<spectrum>.ply`` for the chosen spectra.

    Args:
        arguments: The command's.
        loaded: The run.
        folder: Where to write.

    Raises:
        UserError: The capture cannot be read, an argument is impossible, or scikit-image is missing.
    """
    from thermosplat.export.formats.ply_tables import write_points
    from thermosplat.export.maps.map_frame import scene_bounds
    from thermosplat.export.surfaces.depth_views import depth_points
    from thermosplat.export.surfaces.tsdf_mesh import tsdf_mesh
    from thermosplat.novel_views.viewpoints import viewpoints

    capture = loaded.capture(arguments.data)
    for note in capture.notes:
        print(note)
    temperatures = asked_temperatures(arguments, loaded, capture)
    model, scales, sh_degree = loaded.model, loaded.scales, loaded.sh_degree
    low, high = scene_bounds(capture)
    voxel = arguments.voxel if arguments.voxel is not None else float((high - low).max()) / VOXELS_BY_DEFAULT
    for name in arguments.chosen(list(model.spectra)):
        points = viewpoints(capture, "train", [name], num_frames=1, device=loaded.device)
        views = [point.views[name] for point in points]
        comments = [f"thermosplat {name}", "frame and unit of the capture's poses"]
        comments += [f"temperatures {temperatures.text}"] if temperatures.text else []
        path = folder / f"{arguments.format}_{name}.ply"
        if arguments.format == "points":
            cloud = depth_points(
                model, name, views, scales, sh_degree=sh_degree, most=arguments.points, temperatures=temperatures
            )
            write_points(path, cloud.points, cloud.colors, cloud.values, comments)
            print(f"{path}: {len(cloud.points):,} points{_with(cloud.values)}")
        else:
            bounds = low, high
            mesh = tsdf_mesh(
                model, name, views, scales, bounds, voxel=voxel, sh_degree=sh_degree, temperatures=temperatures
            )
            cloud = mesh.vertices
            write_points(path, cloud.points, cloud.colors, cloud.values, comments, faces=mesh.faces)
            print(f"{path}: {len(mesh.faces):,} triangles of voxels of {voxel:.3g}{_with(cloud.values)}")


def _with(values: Collection[str]) -> str:
    return f", with {', '.join(values)}" if values else ""
