"""Images of a trained scene along a camera path."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.camera_paths import ellipse_path, interpolated_path, spiral_path
from thermosplat.cameras import Camera
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.errors import UserError
from thermosplat.image_display import Image8, rgb_bytes, side_by_side, thermal_bytes
from thermosplat.model import SceneModel
from thermosplat.radiometry import ThermalScale

PathName = Literal["interp", "ellipse", "spiral", "train", "test"]
Shown = Literal["rgb", "thermal", "both"]

_PATHS = {"interp": interpolated_path, "ellipse": ellipse_path, "spiral": spiral_path}


class Viewpoint(NamedTuple):
    """Where one image of the path is taken from; None for a spectrum that is not shown."""

    rgb: ViewTensors | None
    thermal: ViewTensors | None
    frame: str = ""
    """The frame whose views these are, on the train and test paths."""


def viewpoints(
    capture: Capture, path: PathName, shown: Shown, *, num_frames: int, device: torch.device | str
) -> list[Viewpoint]:
    """The cameras along a path.

    "train" and "test" are the capture's own views. The other paths are made from the training poses of the RGB camera
    (of the thermal one where no RGB is shown); the thermal camera rides along with its own intrinsics and its pose
    relative to RGB, both taken from the first training frame.

    Args:
        capture: Gives poses and cameras.
        path: Which path.
        shown: Which spectra.
        num_frames: Images of a made path, >= 1.
        device: Where to put the camera tensors.

    Raises:
        UserError: The capture has no views to make the path from.
    """
    if path == "train" or path == "test":
        frames = [_shown_views(frame, shown) for frame in (capture.train if path == "train" else capture.test)]
        points = [_viewpoint(frame, device) for frame in frames if frame.rgb is not None or frame.thermal is not None]
        if not points:
            raise UserError(f"{capture.name} has no {path} views to render.", "Give another --path.")
        return points
    frames = [_shown_views(frame, shown) for frame in capture.train]
    leading = "thermal" if shown == "thermal" else "rgb"
    leaders = [view for frame in frames if (view := getattr(frame, leading)) is not None]
    if not leaders:
        raise UserError(f"{capture.name} has no {leading} views to make a path from.", "Give another --modality.")
    poses = _PATHS[path](np.stack([view.viewmat for view in leaders]), num_frames)
    if shown != "both":
        cameras = [_view_tensors(leaders[0].camera, pose, device) for pose in poses]
        return [
            Viewpoint(rgb=None, thermal=camera) if leading == "thermal" else Viewpoint(camera, None)
            for camera in cameras
        ]
    pair = next((frame for frame in frames if frame.rgb is not None and frame.thermal is not None), None)
    if pair is None or pair.rgb is None or pair.thermal is None:
        raise UserError(f"{capture.name} has no frame with both spectra.", "Give --modality rgb or thermal.")
    thermal_from_rgb = pair.thermal.viewmat @ np.linalg.inv(pair.rgb.viewmat)
    pairs = []
    for pose in poses:
        rgb = _view_tensors(pair.rgb.camera, pose, device)
        apart = None if pair.aligned else _view_tensors(pair.thermal.camera, thermal_from_rgb @ pose, device)
        pairs.append(Viewpoint(rgb, rgb if apart is None else apart))
    return pairs


@torch.no_grad()
def rendered_images(
    model: SceneModel, points: list[Viewpoint], *, sh_degree: int, thermal_scale: ThermalScale | None
) -> Iterator[Image8]:
    """Render viewpoints one after the other, as images to look at.

    Args:
        model: The scene.
        points: The viewpoints.
        sh_degree: Highest SH degree in use.
        thermal_scale: What the thermal values mean; scalars are shown through its palette.

    Yields:
        8-bit RGB [H, W, 3]; with both spectra, RGB on the left and thermal on the right, scaled to one height.
    """
    for point in points:
        rendered = model.render(point.rgb, point.thermal, sh_degree=sh_degree)
        rgb = None if rendered.rgb is None else rgb_bytes(_array(rendered.rgb))
        thermal = None
        if rendered.thermal is not None and thermal_scale is not None:
            thermal = thermal_bytes(_array(rendered.thermal), thermal_scale)
        if rgb is not None and thermal is not None:
            yield side_by_side(rgb, thermal)
        elif (image := rgb if thermal is None else thermal) is not None:
            yield image


def _array(image: Tensor) -> NDArray[np.float32]:
    return image.cpu().numpy()


def _shown_views(frame: Frame, shown: Shown) -> Frame:
    if shown == "both":
        return frame
    return replace(frame, thermal=None) if shown == "rgb" else replace(frame, rgb=None)


def _viewpoint(frame: Frame, device: torch.device | str) -> Viewpoint:
    rgb = None if frame.rgb is None else _view_tensors(frame.rgb.camera, frame.rgb.viewmat, device)
    if frame.aligned:
        return Viewpoint(rgb, rgb, frame.name)
    thermal = None if frame.thermal is None else _view_tensors(frame.thermal.camera, frame.thermal.viewmat, device)
    return Viewpoint(rgb, thermal, frame.name)


def _view_tensors(camera: Camera, viewmat: NDArray[np.float64], device: torch.device | str) -> ViewTensors:
    """A camera to render from, without an image to compare with."""
    return ViewTensors(
        viewmat=torch.as_tensor(viewmat, dtype=torch.float32, device=device),
        K=torch.as_tensor(camera.K, dtype=torch.float32, device=device),
        width=camera.width,
        height=camera.height,
        image=None,
        intensity=None,
        celsius=None,
    )
