"""A capture with the cameras that training has corrected: what evaluation, rendering and viewers then take."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace

import torch
from torch import Tensor

from thermosplat.datasets.cameras import Camera, LensCoefficients
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors
from thermosplat.refinement.camera_corrections import CameraCorrections, camera_tensors, frame_center
from thermosplat.refinement.camera_motion import moved_frame


@torch.no_grad()
def corrected_capture(capture: Capture, corrections: CameraCorrections) -> Capture:
    """The capture with its cameras corrected.

    Training frames get all corrections. Held-out frames have no pose of their own that was learnt, only those of the
    rig and the lenses (``held_out_poses``).
    """
    exact = deepcopy(corrections).cpu().double()
    numbers = {frame.name: k for k, frame in enumerate(capture.training_frames(corrections.spectra))}
    return replace(
        capture,
        train=tuple(_corrected(frame, exact, numbers.get(frame.name)) for frame in capture.train),
        test=tuple(_corrected(frame, exact, None) for frame in capture.test),
    )


@torch.no_grad()
def with_moved_frames(capture: Capture, motions: Mapping[str, Tensor]) -> Capture:
    """The capture with held-out frames moved as a whole.

    Args:
        motions: (r, t) by the frame's name, shape [6] each, as ``held_out_motions`` finds them.
    """

    def moved(frame: Frame) -> Frame:
        if frame.name not in motions:
            return frame
        cameras = {name: camera_tensors(view) for name, view in frame.views.items()}
        motion = motions[frame.name].double().cpu()
        return _with_cameras(frame, moved_frame(cameras, motion, frame_center(frame), capture.scene_extent))

    return replace(capture, test=tuple(map(moved, capture.test)))


def _corrected(frame: Frame, corrections: CameraCorrections, index: int | None) -> Frame:
    """A frame with corrected cameras; of one that is not trained on, what it shares with others."""
    modelled = {name: view for name, view in frame.views.items() if name in corrections.spectra}
    cameras = {name: camera_tensors(view) for name, view in modelled.items()}
    if index is not None:
        tensors = FrameTensors(frame.name, cameras, frame.shared_cameras, torch.tensor(index))
        return _with_cameras(frame, corrections(tensors).views)
    return _with_cameras(
        frame, {name: corrections.of_camera(name, cameras[name], view.camera) for name, view in modelled.items()}
    )


def _with_cameras(frame: Frame, cameras: Mapping[str, ViewTensors]) -> Frame:
    """The frame with other cameras where there are some; those that were equal are equal bit for bit."""
    views = dict(frame.views)
    for name, tensors in cameras.items():
        K = tensors.K
        camera = Camera(
            float(K[0, 0]),
            float(K[1, 1]),
            float(K[0, 2]),
            float(K[1, 2]),
            tensors.width,
            tensors.height,
            views[name].camera.distortion if tensors.distortion is None else _pair(tensors.distortion),
            _lens(tensors),
        )
        views[name] = replace(views[name], camera=camera, viewmat=tensors.viewmat.numpy())
    return replace(frame, views=views)


def _lens(tensors: ViewTensors) -> LensCoefficients | None:
    if tensors.lens is None:
        return None
    k1, k2, k3, k4, k5, k6, p1, p2 = tensors.lens.tolist()
    return LensCoefficients(tensors.lens_model, (k1, k2, k3, k4, k5, k6), (p1, p2))


def _pair(coefficients: Tensor) -> tuple[float, float]:
    k1, k2 = coefficients.tolist()
    return k1, k2
