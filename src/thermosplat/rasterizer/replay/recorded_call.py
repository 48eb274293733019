"""What is recorded of a call: its forward pass in fixed memory, and its backward pass in two halves.

Backward it is cut where ``info["means2d"]`` lies, between projection and blending: from the images to what passes there
(the mids), and from those to the call's tensors. Backgrounds are read by the blending alone, and are mids, too.

Where the call returns images as the blending wrote them, the blending is not recorded, and neither is its adjoint
(image_launches.py). Of the images only alphas are copied then, where an adjoint will read them.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from thermosplat.rasterizer.blending_autograd import blends_launched_by
from thermosplat.rasterizer.info import InfoTensors, clear_unseen
from thermosplat.rasterizer.packed_info import whole_entries
from thermosplat.rasterizer.projected_scene import ProjectedScene, scenes_told_to
from thermosplat.rasterizer.replay.call_signature import Call, with_tensors
from thermosplat.rasterizer.replay.cuda_graphs import RoomForOne
from thermosplat.rasterizer.replay.image_launches import RENDERS, LaunchedByReplays, LaunchedNow, images_drawn
from thermosplat.rasterizer.replay.replayed_info import InfoLayout

EXTRA = "render_extra_signals"
"""An image that is an entry of ``info``."""

CONSTANT = frozenset(("batch_ids", "camera_ids", "gaussian_ids", "n_batches", "n_cameras")) | frozenset(
    ("width", "height", "tile_size", "tile_width", "tile_height")
)
"""Entries of ``info`` that are the same in every replay."""


class Subject(NamedTuple):
    """A call that is recorded or replayed."""

    function: Callable[..., Any]
    arguments: Sequence[Any]
    options: Mapping[str, Any]
    call: Call
    behind: frozenset[int]
    """Which of its tensors are backgrounds."""

    def with_tensors(self, tensors: Sequence[Tensor]) -> Any:
        """The call as it is, of other tensors."""
        arguments, options = with_tensors(self.arguments, self.options, tensors)
        return self.function(*arguments, **options)


class ImageView(NamedTuple):
    """An image: one of the tensors that are copied, or a part of it."""

    of: int
    strided: tuple[torch.Size, tuple[int, ...], int] | None


class Recorded(NamedTuple):
    """What is the same in every replay."""

    owned: int
    """How many of the written tensors become the caller's: means2d if it is differentiated, and the images."""
    drawn: tuple[int | None, ...]
    """Which of these each of ``Places.images`` is; they are written there, and the others copied."""
    differentiated: bool
    """Whether anything needs a gradient."""
    moves: bool
    """Whether ``info["means2d"]`` needs a gradient."""
    edges: tuple[Tensor, ...]
    """One tensor for all that passes from the projection to the blending, too, and needs a gradient, or none; fixed
    memory of as many numbers as these have together. One gradient is copied where seven would be."""
    wanted: tuple[int, ...]
    """The tensors that the projection's half has gradients to."""
    behind: tuple[int, ...]
    """The backgrounds that need a gradient."""
    views: tuple[ImageView, ...]
    differentiable: tuple[bool, ...]
    """Which images need gradients."""
    given: tuple[bool, ...]
    """Which of the function's results, without info, are no None."""
    make: Callable[[Sequence[Any]], Any]
    """Makes a result of its parts."""
    layout: InfoLayout


class GradientMemory(NamedTuple):
    """Fixed memory for gradients, made by the first run of a call, before anything is captured."""

    to_images: list[Tensor]
    """Of the images that need gradients."""
    to_mids: list[Tensor]
    """Of means2d if it moves, and of the others without backgrounds, end to end; the first half writes them, and the
    second reads them."""
    parts: list[Tensor]
    """The same in the shapes of the mids."""


class RecordedCall:
    """The passes of a call, each to be run once while it is recorded.

    Args:
        memory: For gradients; filled by the first run.
        launcher: Makes the launches on images, or leaves them to the replays.
    """

    def __init__(
        self,
        subject: Subject,
        fixed: Sequence[Tensor],
        room: RoomForOne,
        memory: GradientMemory,
        launcher: LaunchedNow | None = None,
    ) -> None:
        self._subject, self._room, self._memory = subject, room, memory
        self._launcher = LaunchedNow() if launcher is None else launcher
        needs = subject.call.needs
        self._leaves = [one.detach().requires_grad_(needed) for one, needed in zip(fixed, needs, strict=True)]
        self._recorded = True in needs
        self._behind = tuple(i for i in sorted(subject.behind) if needs[i])
        self._wanted = tuple(i for i, needed in enumerate(needs) if needed and i not in subject.behind)

    def forward(self) -> list[Tensor]:
        """Runs the call. Returns what it always copies, ``owned`` tensors, and then what ``info`` is made of."""
        scenes: list[ProjectedScene] = []
        self._launcher.blended.clear()
        with (
            torch.set_grad_enabled(self._recorded),
            scenes_told_to(scenes.append),
            blends_launched_by(self._launcher),
            self._room.step(fixed=True),
        ):
            self._result = self._subject.with_tensors(self._leaves)
            (self._scene,) = scenes
        if self._recorded:
            clear_unseen(self._scene.means2d, self._scene.projected.visible)
        extra = dict.get(self._result[-1], EXTRA)
        self._images = [image for image in (*self._result[:-1], extra) if image is not None]
        bases: list[Tensor] = []
        self._views = tuple(_view(image, bases) for image in self._images)
        shown = self._scene.shown()._replace(roots=self._scene.projected.packed_roots)
        fields = {
            name: tensor
            for name, tensor in zip(InfoTensors._fields, shown, strict=True)
            if tensor is not None and not (name == "means2d" and self._recorded)
        }
        self._handed_on = {
            name: (which, one.shape) for name, one in fields.items() if (which := self._leaf_of(one)) is not None
        }
        given = {leaf.data_ptr() for leaf in self._leaves}  # what is read where it lies may be gone later
        self._in_block = {
            name: tensor.detach().clone() if tensor.data_ptr() in given else tensor.detach().contiguous()
            for name, tensor in fields.items()
            if name not in self._handed_on
        }
        self._seen = [image for image in self._images if image.requires_grad]
        scene = self._scene
        crossing = (scene.projected.roots, scene.depths, scene.opacities, scene.thermal_opacities, *scene.features)
        self._roots = [one for one in (scene.means2d, *crossing) if one is not None and one.requires_grad]
        if not self._memory.to_images:
            self._memory.to_images.extend(map(_zeros_like, self._seen))
            self._make_mids()
        self._owned = [scene.means2d, *bases] if self._recorded else bases
        return [*(one.detach() for one in self._owned), *map(_whole_words, self._in_block.values())]

    def shows_what_is_blended(self) -> bool:
        """Whether the images that ``forward`` returned are those that one blending wrote, with nothing done to them."""
        if len(self._launcher.blended) != 1:
            return False
        (blended,) = self._launcher.blended
        written = {one.ptr for one in images_drawn(blended) if one is not None}
        images = self._owned[1:] if self._recorded else self._owned
        return all(image.data_ptr() in written and image._version == 0 for image in images)

    def _drawn(self) -> tuple[int | None, ...]:
        """Which tensors become the caller's where they are blended."""
        if not isinstance(self._launcher, LaunchedByReplays):
            return ()
        (blended,) = self._launcher.blended
        at = {one.data_ptr(): k for k, one in enumerate(self._owned)}
        images = images_drawn(blended)[: RENDERS if self._recorded else None]
        return tuple(None if one is None else at.get(one.ptr) for one in images)

    def read_in_place(self) -> tuple[int | None, ...]:
        """Which of the images' gradients each of ``Places.gradients`` is, once ``blend_backward`` has run."""
        if not isinstance(self._launcher, LaunchedByReplays):
            return ()
        at = {one.data_ptr(): k for k, one in enumerate(self._memory.to_images)}
        return tuple(None if ptr is None else at.get(ptr) for ptr in self._launcher.read)

    def _leaf_of(self, entry: Tensor) -> int | None:
        """Which of the call's tensors an entry of ``info`` is, as opacities are; None: it is another one."""
        for which, leaf in enumerate(self._leaves):
            if leaf.data_ptr() == entry.data_ptr() and leaf.numel() == entry.numel() and entry.is_contiguous():
                return which
        return None

    def _make_mids(self) -> None:
        """Fixed memory for gradients to the mids."""
        to_mids, parts = self._memory.to_mids, self._memory.parts
        crossing = list(self._roots)
        if self._scene.means2d.requires_grad:
            to_mids.append(_zeros_like(crossing.pop(0)))
            parts.append(to_mids[0])
        if crossing:
            to_mids.append(crossing[0].new_zeros(sum(one.numel() for one in crossing)))
            pieces = to_mids[-1].split([one.numel() for one in crossing])
            parts.extend(piece.view(one.shape) for piece, one in zip(pieces, crossing, strict=True))

    def describe(self) -> Recorded:
        """What is known once ``forward`` has run."""
        moves = self._scene.means2d.requires_grad
        return Recorded(
            len(self._owned),
            self._drawn(),
            self._recorded,
            moves,
            tuple(self._memory.to_mids[1 if moves else 0 :]),
            self._wanted if self._roots else (),
            self._behind,
            self._views,
            tuple(image.requires_grad for image in self._images),
            tuple(one is not None for one in self._result[:-1]),
            getattr(type(self._result), "_make", tuple),
            self._layout(),
        )

    def _layout(self) -> InfoLayout:
        scene, entries = self._scene, self._result[-1].entries
        whole = whole_entries(entries)
        differentiable = {
            "depths": scene.depths,
            "conics": scene.projected.roots,
            "opacities": scene.opacities,
            "thermal_opacities": scene.thermal_opacities,
        }
        return InfoLayout(
            {key: whole.made(key) for key in whole.keys if key in CONSTANT},
            tuple(whole.keys),
            entries is not whole,
            scene.size,
            tuple((name, tensor.shape, tensor.dtype) for name, tensor in self._in_block.items()),
            tuple((name, *of) for name, of in self._handed_on.items()),
            frozenset(key for key, one in differentiable.items() if one is not None and one.requires_grad),
        )

    def blend_backward(self) -> list[Tensor | None]:
        """From gradients to the images to the mids' memory. Returns those to backgrounds; last, the sums of absolute
        gradients, if they are asked for."""
        means2d: Any = self._scene.means2d
        if hasattr(means2d, "absgrad"):
            del means2d.absgrad
        mids = [*self._roots, *[self._leaves[i] for i in self._behind]]
        # in this thread, which alone may end the recording of a graph and begin the next
        with torch.autograd.set_multithreading_enabled(False):
            found = torch.autograd.grad(self._seen, mids, self._memory.to_images, retain_graph=True, allow_unused=True)
        count = len(self._roots)
        for part, one in zip(self._memory.parts, found[:count], strict=True):
            if one is None:
                part.zero_()
        there = [(part, one) for part, one in zip(self._memory.parts, found, strict=False) if one is not None]
        if there:
            torch._foreach_copy_([part for part, _ in there], [one for _, one in there])
        return [
            *[None if one is None else one.contiguous() for one in found[count:]],
            getattr(means2d, "absgrad", None),
        ]

    def project_backward(self) -> list[Tensor | None]:
        """From gradients to the mids to the call's tensors that are wanted."""
        inputs = [self._leaves[i] for i in self._wanted]
        if not inputs or not self._roots:
            return []
        found = torch.autograd.grad(self._roots, inputs, self._memory.parts, retain_graph=True, allow_unused=True)
        return [None if one is None else one.contiguous() for one in found]


def _whole_words(tensor: Tensor) -> Tensor:
    """A tensor, or of one byte for each entry all the memory, which is a multiple of four bytes."""
    return tensor.as_strided((-(-tensor.numel() // 4) * 4,), (1,)) if tensor.dtype == torch.bool else tensor


def _zeros_like(tensor: Tensor) -> Tensor:
    return torch.zeros(tensor.shape, dtype=tensor.dtype, device=tensor.device)


def _view(image: Tensor, bases: list[Tensor]) -> ImageView:
    """Where an image lies; several are often parts of one tensor, which is copied as a whole."""
    base = image._base
    if image.is_contiguous() or base is None or not base.is_contiguous():
        bases.append(image.contiguous())
        return ImageView(len(bases) - 1, None)
    of = next((i for i, one in enumerate(bases) if one is base), len(bases))
    if of == len(bases):
        bases.append(base)
    return ImageView(of, (image.shape, image.stride(), int(image.storage_offset() - base.storage_offset())))


def images_of(views: Sequence[ImageView], bases: Sequence[Tensor]) -> list[Tensor]:
    """The images in copies of the tensors that hold them.

    Args:
        bases: Copies, in their order.
    """
    return [bases[of] if strided is None else bases[of].as_strided(*strided) for of, strided in views]
