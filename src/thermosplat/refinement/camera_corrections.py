"""What is wrong with a capture's cameras, learnt from its images.

Five things may be corrected (``--refine``), each from zero:

- poses: every frame moves as a whole about the centre of its first camera. The mean over all frames is taken off, so
  that the scene stays where it is.
- placed: frames without an image of the first spectrum, which were placed among its images, move in the same way. The
  other frames stay and hold the scene.
- rig: every camera of a spectrum beyond the first moves in its own axes, the same way in all frames.
- intrinsics: one factor per camera on its focal lengths. Where there are several spectra, the cameras of the first keep
  theirs, which were found with the poses from points that many images share. A longer focal length and a smaller scene
  look alike to cameras that stand around it, so the scene would drift.
- distortion: k1 and k2 of COLMAP's RADIAL model per camera, of what undistorting left (scene/lens_distortion.py). Of
  images that are as they were taken, what is added to the lens's own k1 and k2, through which the renderer projects.

What is learnt are coordinates in which all of it moves the images equally far (preconditioning.py). Poses, and the
lenses of the first spectrum, are learnt with the scene, by gradients. The cameras of the other spectra are registered
to the scene from time to time (image_registration.py): no gradient reaches them.

Notation: F frames, L cameras, each a spectrum with intrinsics. A camera's correction θ, shape [9], is (r, t) of the
rig [rad, scene extents], the logarithm of the focal factor, k1 and k2.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from thermosplat.config import OF_FRAMES, Refined
from thermosplat.datasets.cameras import Camera, camera_center
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors, lens_tensor
from thermosplat.refinement.camera_motion import moved_camera, moved_frame, with_focal_factor
from thermosplat.refinement.preconditioning import normal_matrix, points_in_view, preconditioner

POSES: Refined = "poses"
PLACED: Refined = "placed"
RIG: Refined = "rig"
INTRINSICS: Refined = "intrinsics"
DISTORTION: Refined = "distortion"

MOTION, FOCAL, COEFFICIENTS, SIZE = slice(0, 6), 6, slice(7, 9), 9
"""Where in a camera's correction its parts are, and how many numbers it has."""
RATES = {"poses": (1e-4, 2.5e-6), "cameras": (1.5e-3, 5e-6)}
"""Adam's learning rates in the first step and, after an exponential decay, in the last one, in widths of the images:
of the frames' poses, and of the cameras that gradients reach, which are the first spectrum's distortion or the only
one's focal lengths: more, since few steps look at them. Open choice."""
LOOKED_AT = 32
"""Frames, spread over all, that say how a camera's numbers move its images."""


@dataclass(frozen=True)
class SharedCamera:
    """A camera that took many frames."""

    spectrum: str
    camera: Camera
    """Its intrinsics, as the capture has them."""

    def took(self, frame: Frame) -> bool:
        """Whether a frame has an image of it."""
        return self.spectrum in frame.views and frame.views[self.spectrum].camera == self.camera


class CameraCorrections(nn.Module):
    """Corrections of all cameras of a capture.

    Attributes:
        poses: z of each frame [px], shape [F, 6].
        cameras: z of each camera [px], shape [L, 9].
        refined: What is learnt.
        spectra: Names of the spectra, in order; the first one leads.
        shared: The cameras.
        velocity: Last step of each camera that is registered, in the coordinates of z, shape [L, 9].
        registered: Numbers of the cameras that are registered to the scene; gradients reach the others.
        zoomed: Spectra whose focal lengths are corrected.
        scene_extent: Radius of the scene.
        unit: World units of a unit of the scene.
        image_width: Width of the images of the first camera [px]: learning rates are shares of it.

    Args:
        capture: The capture; its training frames are corrected, and its points seen.
        spectra: Names of the modelled spectra, in order.
    """

    def __init__(self, refined: Collection[Refined], capture: Capture, spectra: Sequence[str]) -> None:
        super().__init__()
        frames = capture.training_frames(spectra)
        self.refined = frozenset(refined)
        self.spectra = tuple(spectra)
        self.zoomed = (self.spectra[1:] or self.spectra) if INTRINSICS in self.refined else ()
        self.scene_extent = capture.scene_extent
        self.unit = capture.placement.unit
        found = (SharedCamera(name, f.views[name].camera) for name in spectra for f in frames if name in f.views)
        self.shared: tuple[SharedCamera, ...] = tuple(dict.fromkeys(found))
        self.image_width = self.shared[0].camera.width
        self.poses = nn.Parameter(torch.zeros(len(frames), 6))
        self.cameras = nn.Parameter(torch.zeros(len(self.shared), SIZE))
        self.velocity: Tensor
        self.register_buffer("velocity", torch.zeros(len(self.shared), SIZE))
        self.pose_basis: Tensor
        self.camera_basis: Tensor
        self._centers: Tensor
        self._cameras_of: Tensor
        self.register_buffer("pose_basis", self._pose_bases(frames, capture.points), persistent=False)
        self.register_buffer("camera_basis", self._camera_bases(frames, capture.points), persistent=False)
        centers = np.stack([_center(frame) for frame in frames])
        self.register_buffer("_centers", torch.tensor(centers, dtype=torch.float32), persistent=False)
        number = {camera: k for k, camera in enumerate(self.shared)}
        cameras_of = [
            [number[SharedCamera(name, f.views[name].camera)] if name in f.views else 0 for f in frames]
            for name in spectra
        ]
        self.register_buffer("_cameras_of", torch.tensor(cameras_of), persistent=False)
        beyond = [shared.spectrum != self.spectra[0] for shared in self.shared]
        changes = (self.camera_basis.diagonal(dim1=1, dim2=2) > 0).tolist()
        self._free = [[place for place, free in enumerate(row) if free] for row in changes]
        self.registered = tuple(k for k, (other, free) in enumerate(zip(beyond, self._free)) if other and free)
        learnt = torch.tensor([k not in self.registered for k in range(len(self.shared))])
        self._learnt: Tensor
        self.register_buffer("_learnt", learnt[:, None], persistent=False)
        self._frames_of: list[list[int]] = [
            [place for place, frame in enumerate(frames) if shared.took(frame)] for shared in self.shared
        ]

    def learnt(self) -> dict[str, nn.Parameter]:
        """The parameters that gradients reach, by the name of their learning rate."""
        learnt = {"poses": self.poses} if self.refined & OF_FRAMES else {}
        by_gradient = any(free and number not in self.registered for number, free in enumerate(self._free))
        return learnt | ({"cameras": self.cameras} if by_gradient else {})

    def pose_motions(self) -> Tensor:
        """(r, t) of every frame, shape [F, 6]; their mean is zero where all of them move."""
        motions = (self.pose_basis @ self.poses[:, :, None])[:, :, 0]
        return motions - motions.mean(dim=0) if POSES in self.refined else motions

    def camera_corrections(self) -> Tensor:
        """θ of every camera, shape [L, 9]."""
        cameras = torch.where(self._learnt, self.cameras, self.cameras.detach())
        return (self.camera_basis @ cameras[:, :, None])[:, :, 0]

    def frames_of(self, number: int) -> Sequence[int]:
        """Indices of the training frames that a camera took."""
        return self._frames_of[number]

    def free_coordinates(self, number: int) -> Sequence[int]:
        """Which of a camera's coordinates z change anything."""
        return self._free[number]

    def directions(self, number: int, *, distortion: bool) -> Tensor:
        """Orthonormal directions of a camera's free coordinates, shape [free, n].

        Args:
            distortion: All of them; else those that leave k1 and k2 as they are.
        """
        free = self._free[number]
        basis = self.camera_basis[number][free][:, free]
        kept = [place for place, name in enumerate(free) if distortion or name < COEFFICIENTS.start]
        return torch.linalg.qr(torch.linalg.inv(basis)[:, kept])[0]

    def forward(self, frame: FrameTensors) -> FrameTensors:
        """A training frame with its cameras corrected; no value is read back.

        Returns:
            The frame, through whose cameras gradients reach the corrections.

        Raises:
            ValueError: The frame knows no index.
        """
        if frame.index is None:
            raise ValueError(f"Frame {frame.name} is not one of those that train.")
        index, corrections = frame.index.reshape(1), self.camera_corrections()
        views = {}
        for name, view in frame.views.items():
            number = self._cameras_of[self.spectra.index(name)].index_select(0, index)
            views[name] = self._corrected(name, view, corrections.index_select(0, number).squeeze(0))
        if self.refined & OF_FRAMES:
            motion = self.pose_motions().index_select(0, index).squeeze(0)
            center = self._centers.index_select(0, index).squeeze(0)
            views = moved_frame(views, motion, center, self.scene_extent)
        groups = frame.shared_cameras if self.refined <= OF_FRAMES else tuple((name,) for name in frame.views)
        return replace(frame, views=views, shared_cameras=groups)

    def of_camera(self, spectrum: str, view: ViewTensors, camera: Camera) -> ViewTensors:
        """A view of any frame, held out or new, with what all views of its camera have in common corrected.

        Args:
            camera: Its camera as the capture has it. One that no training frame has takes the corrections of the only
                camera of its spectrum, or none where there are several.
        """
        of_spectrum = [k for k, shared in enumerate(self.shared) if shared.spectrum == spectrum]
        known = [k for k in of_spectrum if self.shared[k].camera == camera]
        found = known or (of_spectrum if len(of_spectrum) == 1 else [])
        return self._corrected(spectrum, view, self.camera_corrections()[found[0]]) if found else view

    def _corrected(self, spectrum: str, view: ViewTensors, correction: Tensor) -> ViewTensors:
        """A view with rig, focal lengths and distortion corrected by θ, shape [9]."""
        if RIG in self.refined and spectrum != self.spectra[0]:
            view = moved_camera(view, correction[MOTION], self.scene_extent)
        if spectrum in self.zoomed:
            view = with_focal_factor(view, correction[FOCAL])
        if DISTORTION in self.refined and view.lens is not None:
            view = replace(view, lens=view.lens + torch.nn.functional.pad(correction[COEFFICIENTS], (0, 6)))
        elif DISTORTION in self.refined:
            view = replace(view, distortion=correction[COEFFICIENTS])
        return view

    def _pose_bases(self, frames: Sequence[Frame], points: NDArray[np.float32]) -> Tensor:
        """P of every frame's pose, shape [F, 6, 6]; zero where a frame stays."""
        bases = torch.zeros(len(frames), 6, 6)
        for place, frame in enumerate(frames):
            if frame_moves(self.refined, frame, self.spectra):
                bases[place] = pose_basis(frame, points, self.scene_extent)
        return bases

    def _camera_bases(self, frames: Sequence[Frame], points: NDArray[np.float32]) -> Tensor:
        """P of every camera, shape [L, 9, 9]; zero where nothing is refined."""
        bases = torch.zeros(len(self.shared), SIZE, SIZE)
        known = torch.from_numpy(points).double()
        for place, shared in enumerate(self.shared if self.refined - OF_FRAMES else ()):
            name = shared.spectrum
            taken = [f.views[name] for f in frames if name in f.views and f.views[name].camera == shared.camera]
            views = [camera_tensors(shown) for shown in taken[:: -(-len(taken) // LOOKED_AT)]]
            normals = [
                normal_matrix(
                    partial(self._corrected, name, view), SIZE, points_in_view(view, known, self.scene_extent)
                )
                for view in views
            ]
            bases[place] = preconditioner(torch.stack(normals).mean(dim=0)).float()
        return bases


def frame_moves(refined: Collection[Refined], frame: Frame, spectra: Sequence[str]) -> bool:
    """Whether a frame has a pose of its own that is corrected.

    Args:
        spectra: Names of the modelled spectra; the first one leads.
    """
    return POSES in refined or (PLACED in refined and spectra[0] not in frame.views)


def pose_basis(frame: Frame, points: NDArray[np.float32], scene_extent: float) -> Tensor:
    """P of a frame's motion as a whole, float32 [6, 6]: from z [px] to (r, t) [rad, scene extents].

    Args:
        points: The capture's points [world units], shape [M, 3].
        scene_extent: Radius of the scene [world units].
    """
    known, center = torch.from_numpy(points).double(), torch.from_numpy(_center(frame))
    normal = torch.zeros(6, 6, dtype=torch.float64)
    for name, shown in frame.views.items():
        view = camera_tensors(shown)

        def moved(motion: Tensor, name: str = name, view: ViewTensors = view) -> ViewTensors:
            return moved_frame({name: view}, motion, center, scene_extent)[name]

        normal += normal_matrix(moved, 6, points_in_view(view, known, scene_extent))
    return preconditioner(normal / len(frame.views)).float()


def camera_tensors(view: View) -> ViewTensors:
    """Pose and intrinsics of a view in double precision, without its image."""
    camera = view.camera
    distortion = None if camera.distortion is None else torch.tensor(camera.distortion, dtype=torch.float64)
    pose, K = torch.from_numpy(view.viewmat), torch.from_numpy(camera.K)
    lens = lens_tensor(camera, "cpu")
    return ViewTensors(
        pose,
        K,
        camera.width,
        camera.height,
        distortion=distortion,
        lens=None if lens is None else lens.double(),
        lens_model=camera.lens_model,
        readout=None if view.readout is None else torch.from_numpy(view.readout.motion),
        line_order="top-to-bottom" if view.readout is None else view.readout.order,
    )


def frame_center(frame: Frame) -> Tensor:
    """Where a frame's first camera stands [world units], float64 [3]: about it the frame turns."""
    return torch.from_numpy(_center(frame))


def _center(frame: Frame) -> NDArray[np.float64]:
    return camera_center(next(iter(frame.views.values())).viewmat)
