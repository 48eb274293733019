"""Images of a trained scene along a camera path."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import ViewTensors, distortion_tensor, without_pixels
from thermosplat.errors import UserError
from thermosplat.novel_views.bookmarks import Bookmark, fov_camera, path_through
from thermosplat.novel_views.camera_paths import ellipse_path, interpolated_path, spiral_path
from thermosplat.pictures.hatching import hatched
from thermosplat.pictures.image_display import Image8, rgb_bytes, spectrum_bytes
from thermosplat.pictures.layouts import Layout, arranged, with_legend
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import listed, unit_label
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermography.scene_temperatures import SceneTemperatures

PathName = Literal["interp", "ellipse", "spiral", "train", "test"]
PATHS: tuple[PathName, ...] = get_args(PathName)

_PATHS = {"interp": interpolated_path, "ellipse": ellipse_path, "spiral": spiral_path}


class Viewpoint(NamedTuple):
    """Where one image of the path is taken from."""

    views: dict[str, ViewTensors]
    """Camera by spectrum that is shown."""
    frame: str = ""
    """The frame whose views these are, on the train and test paths."""


def viewpoints(
    capture: Capture, path: PathName, shown: Collection[str], *, num_frames: int, device: torch.device | str
) -> list[Viewpoint]:
    """The cameras along a path.

    "train" and "test" are the capture's own views. The other paths are made from the training poses of the first shown
    spectrum. The other cameras ride along with their own intrinsics and their poses relative to that one, taken from
    the first training frame that has all of them; as pinholes, without their lenses.

    Args:
        capture: Gives poses and cameras.
        shown: Names of the spectra, at least one.
        num_frames: Images of a made path, >= 1.
        device: Where to put the camera tensors.

    Raises:
        UserError: The capture has no views to make the path from.
    """
    if path == "train" or path == "test":
        frames = capture.train if path == "train" else capture.test
        points = [_viewpoint(frame, shown, device) for frame in frames if frame.views.keys() & set(shown)]
        if not points:
            raise UserError(f"{capture.name} has no {path} views to render.", "Give another --path.")
        return points
    names = [name for name in capture.spectra if name in shown]
    leading = names[0]
    leaders = [frame.views[leading] for frame in capture.train if leading in frame.views]
    if not leaders:
        raise UserError(f"{capture.name} has no {leading} views to make a path from.", "Give other --spectra.")
    poses = _PATHS[path](np.stack([view.viewmat for view in leaders]), num_frames)
    together = next((frame for frame in capture.train if set(names) <= frame.views.keys()), None)
    if together is None:
        raise UserError(f"{capture.name} has no frame with {listed(names)}.", "Show one of them: --spectra.")
    cameras = {name: replace(together.views[name].camera, lens=None) for name in names}
    from_leading = {
        name: together.views[name].viewmat @ np.linalg.inv(together.views[leading].viewmat) for name in names
    }
    lenders = {name: next(group[0] for group in together.shared_cameras if name in group) for name in names}
    made = []
    for pose in poses:
        own = {
            lender: _view_tensors(
                cameras[name], pose if lender == lenders[leading] else from_leading[name] @ pose, device
            )
            for name, lender in lenders.items()
        }
        made.append(Viewpoint({name: own[lender] for name, lender in lenders.items()}))
    return made


def bookmarked_viewpoints(
    capture: Capture,
    bookmarks: Sequence[Bookmark],
    shown: Collection[str],
    *,
    num_frames: int,
    device: torch.device | str,
) -> list[Viewpoint]:
    """The cameras along a path through bookmarks; all spectra are seen by the same one.

    Args:
        capture: Its first training view of a shown spectrum gives the size of the images.
        bookmarks: At least two, as files have them.
        shown: Names of the spectra, at least one.
        num_frames: Images of the path, >= 1.
        device: Where to put the camera tensors.

    Raises:
        UserError: There are fewer than two bookmarks, or no training view.
    """
    names = [name for name in capture.spectra if name in shown]
    first = next((frame.views[name] for name in names for frame in capture.train if name in frame.views), None)
    if first is None:
        raise UserError(f"{capture.name} has no {listed(names)} views to take the size of the images from.")
    size = first.camera.width, first.camera.height
    stops = path_through([bookmark.in_scene(capture.placement) for bookmark in bookmarks], num_frames)
    return [
        Viewpoint(dict.fromkeys(names, _view_tensors(fov_camera(stop.fov_y, *size), stop.viewmat, device)))
        for stop in stops
    ]


@torch.no_grad()
def rendered_images(
    model: SceneModel,
    points: list[Viewpoint],
    *,
    sh_degree: int,
    scales: Mapping[str, PixelScale],
    layout: Layout = "side-by-side",
    color_bar: bool = False,
    title: str = "",
    temperatures: SceneTemperatures | None = None,
    ranges: Mapping[str, tuple[float, float] | None] | None = None,
    measured: Callable[[int, str, NDArray[np.float32]], None] | None = None,
) -> Iterator[Image8]:
    """Render viewpoints one after the other, as images to look at.

    Args:
        scales: What pixel values mean, by spectrum; scalars are shown through their palettes.
        layout: How the shown spectra are put together (:func:`~thermosplat.pictures.layouts.arranged`).
        color_bar: Put a colour bar of each measured spectrum beside the picture.
        title: One line above it; "" for none.
        temperatures: How temperatures are recalculated; None: they are not. Pictures that are say so in the title, and
            pixels that are not are hatched.
        ranges: Values at the palettes' ends by spectrum (``display_range``); None: those of the scales. Recalculated
            temperatures have their own.
        measured: Takes the number of each viewpoint, the name of each measured spectrum and its values [H, W] in its
            unit, recalculated as the pictures are; NaN where Gaussians cover less than 90% in every spectrum.

    Yields:
        8-bit RGB [H, W, 3].
    """
    if temperatures is not None and temperatures.text:
        title = "; ".join(filter(None, (title, temperatures.text)))
        scales = {name: temperatures.shown_scale(name) for name in scales}
    for index, point in enumerate(points):
        rendered = model.render(point.views, sh_degree=sh_degree)
        names = [name for name in model.spectra if name in rendered.images]
        if not names:
            continue
        for name in names:
            if measured is not None and scales[name].has_intensity and scales[name].measured_unit is not None:
                image, view = rendered.images[name], point.views[name]
                is_whole = all(point.views.get(other) is view for other in model.spectra)
                whole = dict.fromkeys(model.spectra, view)
                covered = (rendered if is_whole else model.render(whole, sh_degree=sh_degree)).covered()
                measured(index, name, _values(name, image, covered, view, scales[name], temperatures))
        spans = {} if ranges is None or (temperatures is not None and temperatures.text) else ranges
        images = [
            _picture(name, rendered.images[name], point.views[name], scales[name], temperatures, spans.get(name))
            for name in names
        ]
        picture = arranged(images, layout, index / max(1, len(points) - 1))
        if color_bar or title:
            barred = [name for name in names if color_bar and scales[name].measured_unit is not None]
            units = [unit_label(scales[name].measured_unit or "") for name in barred]
            shown_scales = [replace(scales[name], range=spans.get(name) or scales[name].range) for name in barred]
            picture = with_legend(picture, shown_scales, units, title)
        yield picture


def _picture(
    name: str,
    image: Tensor,
    view: ViewTensors,
    scale: PixelScale,
    temperatures: SceneTemperatures | None,
    span: tuple[float, float] | None,
) -> Image8:
    """A rendered image for the eye; recalculated where that is asked for, with ``scale`` the recalculated one."""
    if temperatures is None or not temperatures.recalculates(name) or scale.range is None:
        return spectrum_bytes(image.cpu().numpy(), scale, span)
    made = temperatures.of_image(name, image, view)
    low, high = scale.range
    shares = (made.values.cpu().numpy() - low) / max(high - low, 1e-12)
    picture = rgb_bytes(scale.palette.to_color(shares))
    return picture if made.changed is None else hatched(picture, ~made.changed)


def _values(
    name: str,
    image: Tensor,
    covered: Tensor,
    view: ViewTensors,
    scale: PixelScale,
    temperatures: SceneTemperatures | None,
) -> NDArray[np.float32]:
    """Measured values [H, W] of a rendered image [H, W, C], recalculated where that is asked for; NaN elsewhere."""
    if temperatures is not None and temperatures.recalculates(name):
        values = temperatures.of_image(name, image, view).values.to(image)
    else:
        values = scale.value(pixel_intensity(image.clamp(0, 1), scale))
    return torch.where(covered, values, torch.nan).cpu().numpy().astype(np.float32)


def _viewpoint(frame: Frame, shown: Collection[str], device: torch.device | str) -> Viewpoint:
    cameras: dict[str, ViewTensors] = {}
    for group in frame.shared_cameras:
        names = [name for name in group if name in shown]
        if names:
            cameras |= dict.fromkeys(names, without_pixels(frame.views[names[0]], device))
    return Viewpoint(cameras, frame.name)


def _view_tensors(camera: Camera, viewmat: NDArray[np.float64], device: torch.device | str) -> ViewTensors:
    """A camera to render from, without an image to compare with."""
    return ViewTensors(
        viewmat=torch.as_tensor(viewmat, dtype=torch.float32, device=device),
        K=torch.as_tensor(camera.K, dtype=torch.float32, device=device),
        width=camera.width,
        height=camera.height,
        distortion=distortion_tensor(camera, device),
    )
