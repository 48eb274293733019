"""Images of a trained scene along a camera path."""

from collections.abc import Collection, Iterator, Mapping
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import ViewTensors, distortion_tensor
from thermosplat.errors import UserError
from thermosplat.novel_views.camera_paths import ellipse_path, interpolated_path, spiral_path
from thermosplat.pictures.image_display import Image8, side_by_side, spectrum_bytes
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import listed
from thermosplat.thermal.radiometry import PixelScale

PathName = Literal["interp", "ellipse", "spiral", "train", "test"]

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
    the first training frame that has all of them.

    Args:
        capture: Gives poses and cameras.
        path: Which path.
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
    cameras = {name: together.views[name].camera for name in names}
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


@torch.no_grad()
def rendered_images(
    model: SceneModel, points: list[Viewpoint], *, sh_degree: int, scales: Mapping[str, PixelScale]
) -> Iterator[Image8]:
    """Render viewpoints one after the other, as images to look at.

    Args:
        model: The scene.
        points: The viewpoints.
        sh_degree: Highest SH degree in use.
        scales: What pixel values mean, by spectrum; scalars are shown through their palettes.

    Yields:
        8-bit RGB [H, W, 3]: the shown spectra side by side, scaled to one height.
    """
    for point in points:
        rendered = model.render(point.views, sh_degree=sh_degree)
        images = [
            spectrum_bytes(rendered.images[name].cpu().numpy(), scales[name])
            for name in model.spectra
            if name in rendered.images
        ]
        if images:
            yield side_by_side(images)


def _viewpoint(frame: Frame, shown: Collection[str], device: torch.device | str) -> Viewpoint:
    cameras: dict[str, ViewTensors] = {}
    for group in frame.shared_cameras:
        names = [name for name in group if name in shown]
        if names:
            view = frame.views[names[0]]
            cameras |= dict.fromkeys(names, _view_tensors(view.camera, view.viewmat, device))
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
