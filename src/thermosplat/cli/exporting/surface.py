"""thermosplat-export --format points, las or mesh: the surfaces that the spectra see."""

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
    """Write ``points_<spectrum>.ply``, ``points_<spectrum>.las`` or ``mesh_<spectrum>.ply`` for the chosen spectra.

    Raises:
        UserError: The capture cannot be read, an argument is impossible, or scikit-image or laspy is missing.
    """
    import numpy as np

    from thermosplat.export.export_frame import ExportFrame
    from thermosplat.export.formats.las import check_laspy, write_las
    from thermosplat.export.formats.ply_tables import write_points
    from thermosplat.export.maps.map_frame import scene_bounds
    from thermosplat.export.surfaces.depth_views import depth_points
    from thermosplat.export.surfaces.tsdf_mesh import tsdf_mesh
    from thermosplat.novel_views.viewpoints import viewpoints

    if arguments.format == "las":
        check_laspy()
    capture = loaded.capture(arguments.data)
    for note in capture.notes:
        print(note)
    temperatures = asked_temperatures(arguments, loaded, capture)
    model, scales, sh_degree = loaded.model, loaded.scales, loaded.sh_degree
    frame = ExportFrame(model.placement, loaded.geo)
    low, high = scene_bounds(capture)
    voxel = arguments.voxel if arguments.voxel is not None else float((high - low).max()) / VOXELS_BY_DEFAULT
    for name in arguments.chosen(list(model.spectra)):
        points = viewpoints(capture, "train", [name], num_frames=1, device=loaded.device)
        views = [point.views[name] for point in points]
        about = "frame and unit of the capture's poses" if frame.geo is None else frame.comments()[0]
        comments = [f"thermosplat {name}", about]
        comments += [f"temperatures {temperatures.text}"] if temperatures.text else []
        path = folder / f"{'mesh' if arguments.format == 'mesh' else 'points'}_{name}.ply"
        if arguments.format != "mesh":
            cloud = depth_points(
                model, name, views, scales, sh_degree=sh_degree, most=arguments.points, temperatures=temperatures
            )
            if arguments.format == "las":
                path, geo = path.with_suffix(".las"), frame.geo
                coordinates = cloud.points.astype(np.float64) if geo is None else geo.to_utm(cloud.points)
                write_las(path, coordinates, cloud.colors, cloud.values, None if geo is None else geo.epsg)
            else:
                write_points(path, frame.points(cloud.points), cloud.colors, cloud.values, comments)
            print(f"{path}: {len(cloud.points):,} points{_with(cloud.values)}")
        else:
            bounds = low, high
            mesh = tsdf_mesh(
                model, name, views, scales, bounds, voxel=voxel, sh_degree=sh_degree, temperatures=temperatures
            )
            cloud = mesh.vertices
            vertices = frame.points(cloud.points)
            write_points(path, vertices, cloud.colors, cloud.values, comments, faces=mesh.faces)
            print(f"{path}: {len(mesh.faces):,} triangles of voxels of {voxel:.3g}{_with(cloud.values)}")
    if frame.geo is not None:
        for line in frame.write(folder):
            print(line)


def _with(values: Collection[str]) -> str:
    return f", with {', '.join(values)}" if values else ""
