"""Frames as torch tensors: what the model renders from and the losses compare with."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import Frame, View
from thermosplat.datasets.readouts import LineOrder, Readout
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermal.radiometry import PixelScale


@dataclass(frozen=True, eq=False)
class ViewTensors:
    """A view on a device.

    Args:
        viewmat: [4, 4] float32, scene to camera (``LoadedRun.view`` makes one of the world's).
        K: [3, 3] float32 intrinsics [px].
        width: Image width [px].
        height: Image height [px].
        image: [H, W, C] float32 in [0, 1], or uint8 as its file has it (``with_unit_images``); None for a camera
            without an image (novel views).
        intensity: [H, W] float32 scalar intensity in [0, 1]; None of photographs.
        values: [H, W] float32 measured values in the unit of the spectrum's scale; of views that have them only.
        mask: [H, W] bool, where pixels are compared; None: everywhere.
        distortion: [2] float32, k1 and k2 of a lens that is no pinhole (``scene.lens_distortion``).
        lens: [8] float32, k1 to k6, p1 and p2 of the lens that the view is rendered through; None: of none.
        lens_model: What the lens is: the rasterizer's ``camera_model``, "pinhole" without one.
        readout: [2, 4, 4] float32, where lines are read one after the other: the camera's motion from the view's pose
            to that at the first line, and to that at the last (``datasets.readouts``). None: all at once.
        line_order: In which order lines are read, with a readout.
        unscented: A pinhole camera without a lens sees Gaussians by the unscented transform too, as lenses do.
        orthographic: Rays are parallel: x, y in camera axes times fx, fy [px per unit of the scene] plus cx, cy.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    image: Tensor | None = None
    intensity: Tensor | None = None
    values: Tensor | None = None
    mask: Tensor | None = None
    distortion: Tensor | None = None
    orthographic: bool = False
    lens: Tensor | None = None
    lens_model: str = "pinhole"
    readout: Tensor | None = None
    line_order: LineOrder = "top-to-bottom"
    unscented: bool = False

    def as_pinhole(self) -> "ViewTensors":
        """The view by a pinhole camera without a lens, which takes its image at once."""
        return replace(self, distortion=None, lens=None, lens_model="pinhole", readout=None)


@dataclass(frozen=True, eq=False)
class FrameTensors:
    """A frame on a device: views by spectrum, and `shared_cameras` as ``Frame.shared_cameras``.

    Training frames know their place among them: `index`, int64 scalar on the device. Of a frame that is ``packed``, all
    tensors but measured values lie in `memory`, float32 [n].
    """

    name: str
    views: Mapping[str, ViewTensors]
    shared_cameras: tuple[tuple[str, ...], ...]
    index: Tensor | None = None
    memory: Tensor | None = None

    def packable(self) -> list[Tensor]:
        """The tensors that ``memory`` holds where there is one."""
        views = self.views.values()
        tensors = [
            tensor
            for view in views
            for tensor in (view.viewmat, view.K, view.image, view.intensity, view.mask, view.lens, view.readout)
        ]
        return [tensor for tensor in (*tensors, self.index) if tensor is not None]

    @property
    def num_bytes(self) -> int:
        """Memory of the images and values [bytes]."""
        kept = (held for view in self.views.values() for held in (view.image, view.intensity, view.values, view.mask))
        return sum(held.numel() * held.element_size() for held in kept if isinstance(held, Tensor))

    def only(self, spectra: Collection[str]) -> "FrameTensors":
        """The frame with the views of some spectra alone."""
        if set(self.views) <= set(spectra):
            return self
        groups = (tuple(name for name in group if name in spectra) for group in self.shared_cameras)
        views = {name: view for name, view in self.views.items() if name in spectra}
        return replace(self, views=views, shared_cameras=tuple(filter(None, groups)))


ALIGNED = 16
"""Numbers of a packed frame's memory that every tensor starts at a multiple of."""


def packed(frame: FrameTensors) -> FrameTensors:
    """The same frame in one piece of memory, so that a training step takes it over by a single copy."""
    tensors = frame.packable()
    sizes = [-(-_numbers(tensor) // ALIGNED) * ALIGNED for tensor in tensors]
    starts = dict(zip(map(id, tensors), accumulate(sizes, initial=0)))
    memory = torch.zeros(sum(sizes), dtype=torch.float32, device=tensors[0].device)
    return _placed(frame, memory, lambda tensor: _part(memory, starts[id(tensor)], tensor).copy_(tensor))


def packed_elsewhere(frame: FrameTensors) -> FrameTensors:
    """A copy of a packed frame, or of what is left of it without a view: everything is at the same place in it."""
    memory = packed_memory(frame).clone()
    return _placed(frame, memory, lambda tensor: _part(memory, place_in_frame(frame, tensor), tensor))


def place_in_frame(frame: FrameTensors, tensor: Tensor) -> int:
    """Where in a packed frame's memory a tensor of it starts [numbers]."""
    memory = packed_memory(frame)
    return (tensor.data_ptr() - memory.data_ptr()) // memory.element_size()


def packed_memory(frame: FrameTensors) -> Tensor:
    """The memory of a packed frame.

    Raises:
        ValueError: of another frame.
    """
    if frame.memory is None:
        raise ValueError(f"Frame {frame.name} is not packed.")
    return frame.memory


def _placed(frame: FrameTensors, memory: Tensor, place: Callable[[Tensor], Tensor]) -> FrameTensors:
    """The frame with other tensors for those that can be packed."""

    def placed(view: ViewTensors) -> ViewTensors:
        image, intensity, mask, lens, readout = (
            None if tensor is None else place(tensor)
            for tensor in (view.image, view.intensity, view.mask, view.lens, view.readout)
        )
        moved = replace(view, viewmat=place(view.viewmat), K=place(view.K), image=image, intensity=intensity)
        return replace(moved, mask=mask, lens=lens, readout=readout)

    index = None if frame.index is None else place(frame.index)
    return replace(frame, views={name: placed(v) for name, v in frame.views.items()}, index=index, memory=memory)


def _part(memory: Tensor, start: int, like: Tensor) -> Tensor:
    """The part of a memory from a number on that holds a tensor of that shape and type."""
    return memory[start : start + _numbers(like)].view(like.dtype)[: like.numel()].view(like.shape)


def _numbers(tensor: Tensor) -> int:
    """float32 numbers that have room for its bytes."""
    return -(-tensor.numel() * tensor.element_size() // 4)


def frame_tensors(
    frame: Frame, scales: Mapping[str, PixelScale], device: torch.device | str, *, as_bytes: bool = False
) -> FrameTensors:
    """Put a frame on a device.

    Args:
        scales: The capture's, by spectrum.
        as_bytes: Images that are bytes stay bytes, in a quarter of the memory.
    """
    views = {name: view_tensors(view, scales[name], device, as_bytes=as_bytes) for name, view in frame.views.items()}
    return FrameTensors(frame.name, views, frame.shared_cameras)


def view_tensors(
    view: View, scale: PixelScale | None, device: torch.device | str, *, as_bytes: bool = False
) -> ViewTensors:
    """Put a view on a device; with a scale also its scalar intensity (inverse palette, or the scalar itself).

    Args:
        scale: What its pixels mean; None: no intensity is wanted.
    """
    held = view.pixels()
    stored = held.image if held.image.dtype == np.uint8 else held.image.astype(np.float32)
    image = torch.tensor(stored, device=device)
    if not as_bytes:
        image = unit_image(image)
    is_scalar = scale is not None and scale.has_intensity
    return replace(
        without_pixels(view, device),
        image=image,
        intensity=_intensity(held.image, unit_image(image), scale) if scale is not None and is_scalar else None,
        values=None if held.values is None else torch.tensor(held.values, device=device),
        mask=None if held.mask is None else torch.tensor(held.mask, device=device),
    )


def without_pixels(view: View, device: torch.device | str) -> ViewTensors:
    """Put the camera of a view on a device."""
    return ViewTensors(
        torch.tensor(view.viewmat, dtype=torch.float32, device=device),
        torch.tensor(view.camera.K, dtype=torch.float32, device=device),
        view.camera.width,
        view.camera.height,
        distortion=distortion_tensor(view.camera, device),
        lens=lens_tensor(view.camera, device),
        lens_model=view.camera.lens_model,
        readout=readout_tensor(view.readout, device),
        line_order="top-to-bottom" if view.readout is None else view.readout.order,
    )


def with_pixels(
    camera: ViewTensors, image: Tensor, intensity: Tensor | None, scale: PixelScale, mask: Tensor | None = None
) -> ViewTensors:
    """A view with pixels as they are stored, the same as ``view_tensors`` makes of them ``as_bytes``.

    Args:
        camera: The view without pixels.
        image: uint8 or float32 [H, W, C], on the camera's device.
        intensity: float32 [H, W] of pseudo-colours; None of others.
        scale: What the pixels mean.
        mask: bool [H, W], where pixels are compared; None: everywhere.
    """
    if intensity is None and scale.has_intensity:
        intensity = pixel_intensity(unit_image(image), scale)
    return replace(camera, image=image, intensity=intensity, mask=mask)


def with_unit_images(frame: FrameTensors) -> FrameTensors:
    """The frame with images in [0, 1] where they are bytes, the same as ``frame_tensors`` makes of them."""
    as_bytes = {
        name: replace(view, image=unit_image(view.image))
        for name, view in frame.views.items()
        if view.image is not None and view.image.dtype == torch.uint8
    }
    return replace(frame, views={**frame.views, **as_bytes}, memory=None) if as_bytes else frame


def unit_image(image: Tensor) -> Tensor:
    """float32 in [0, 1] of bytes; float32 stays as it is."""
    if image.dtype != torch.uint8:
        return image
    # by a tensor: CUDA multiplies by the inverse of a number
    return image / torch.full((), 255.0, dtype=torch.float32, device=image.device)


def distortion_tensor(camera: Camera, device: torch.device | str) -> Tensor | None:
    """k1 and k2 of a camera on a device, [2] float32; None of a pinhole."""
    return None if camera.distortion is None else torch.tensor(camera.distortion, dtype=torch.float32, device=device)


def lens_tensor(camera: Camera, device: torch.device | str) -> Tensor | None:
    """k1 to k6, p1 and p2 of a camera's lens on a device, [8] float32; None of a pinhole."""
    if camera.lens is None:
        return None
    return torch.tensor([*camera.lens.radial, *camera.lens.tangential], dtype=torch.float32, device=device)


def readout_tensor(readout: Readout | None, device: torch.device | str) -> Tensor | None:
    """The motion of a readout on a device, [2, 4, 4] float32; None of an image that is taken at once."""
    return None if readout is None else torch.tensor(readout.motion, dtype=torch.float32, device=device)


def _intensity(image: NDArray[Any], pixels: Tensor, scale: PixelScale) -> Tensor:
    """Scalar intensity [H, W] of an image as it is stored and as the tensor made of it, on the tensor's device."""
    if scale.kind == "color" and pixels.device.type == "cpu":
        return torch.from_numpy(scale.palette.to_intensity(image))  # of levels it is quicker
    return pixel_intensity(pixels, scale)
