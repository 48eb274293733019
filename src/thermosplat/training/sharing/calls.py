"""The calls of the renderer that ranks make together for their frames.

Where Gaussians are divided, every rank makes every call, and gives it a camera. Frames may lack views, and spectra of
one frame may share a camera where those of another do not: a rank whose frame has no view for a call gives it a small
camera that sees nothing.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.distributed.team import Team
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.training.step_kind import Group

BLANK_SIZE = 16
"""Width and height of the image of a camera that sees nothing [px]: one tile."""
AWAY = -1e6
"""Where in front of such a camera the scene's origin is [world units]: behind it."""


class Calls(NamedTuple):
    """What all ranks render at a time."""

    groups: list[Group]
    """Every group that some rank's frame has, in an order that all ranks agree on."""
    of_ranks: list[set[Group]]
    """The groups of each rank's frame; none of a rank without a frame."""
    rank: int
    like: Tensor


def calls_of(frames: Sequence[Sequence[Group]], team: Team, like: Tensor) -> Calls:
    """The calls for the frames that the ranks have now.

    Args:
        frames: The groups of the frames of the first ranks; the others have none.
    """
    groups = dict.fromkeys(group for frame in frames for group in frame)
    of_ranks = [set(frame) for frame in frames] + [set() for _ in range(team.size - len(frames))]
    return Calls(sorted(groups), of_ranks, team.rank, like.detach())


def render_with_others(
    render: Callable[..., RenderedFrame], views: Mapping[str, ViewTensors], calls: Calls
) -> RenderedFrame:
    """Render a rank's frame while the other ranks render theirs.

    Args:
        render: ``SceneModel.render`` with its options.
        views: The frame's; none where the rank has no frame.

    Returns:
        The frame. ``infos`` holds every call by set, in the order of ``calls.groups``; under "group" the group.
    """
    rendered = RenderedFrame()
    for group in calls.groups:
        is_own = group in calls.of_ranks[calls.rank]
        shown = {name: views[name] if is_own else _blank(calls.like.dtype, calls.like.device) for name in group}
        part = render(shown, shared_cameras=[group], distributed=True)
        if is_own:
            rendered.include(part)
        else:
            rendered.blank += [*part.images.values(), *part.features.values(), *part.depth_spreads]
        for name, infos in part.infos.items():
            for info in infos:
                info["group"] = group
            rendered.infos.setdefault(name, []).extend(infos)
    return rendered


@functools.cache  # numbers of the host have no way into a CUDA graph
def _blank(dtype: torch.dtype, device: torch.device) -> ViewTensors:
    viewmat = torch.eye(4, dtype=dtype, device=device)
    viewmat[2, 3] = AWAY
    focal = float(BLANK_SIZE)
    numbers = [[focal, 0.0, focal / 2], [0.0, focal, focal / 2], [0.0, 0.0, 1.0]]
    K = torch.tensor(numbers, dtype=dtype, device=device)
    return ViewTensors(viewmat, K, BLANK_SIZE, BLANK_SIZE)


def infos_of_frame(
    infos: Mapping[str, Sequence[dict[str, Any]]], camera: int, groups: set[Group] | None, frames: int
) -> dict[str, list[Any]]:
    """What density control looks at of one frame, by set.

    Args:
        camera: Which camera of each call is the frame's.
        groups: The frame's groups; None: all calls are its own.
    """
    found: dict[str, list[Any]] = {}
    for name, calls in infos.items():
        for info in calls:
            if groups is None or info["group"] in groups:
                found.setdefault(name, []).append(_info_of_frame(info, camera, frames))
    return found


def _info_of_frame(info: dict[str, Any], camera: int, frames: int) -> dict[str, Any]:
    """What a call says of one camera; the loss is the mean over the frames, so the frame's own gradient is larger."""

    def own(gradient: Tensor | None) -> Tensor | None:  # [1, N, 2] of [C, N, 2]
        if gradient is None:
            return None
        of_frame = gradient[camera : camera + 1]
        return of_frame if frames == 1 else of_frame * frames

    means2d = info["means2d"]
    width, height = info["sizes"][camera] if "sizes" in info else (info["width"], info["height"])
    return {
        "means2d": SimpleNamespace(
            grad=own(means2d.grad if means2d.retains_grad else None), absgrad=own(getattr(means2d, "absgrad", None))
        ),
        "visible": info["visible"][camera : camera + 1],
        "width": width,
        "height": height,
        "n_cameras": 1,
        "spectra": info["spectra"],
    }


class TakingPart(torch.autograd.Function):
    """Depends on images without a gradient to them: autograd visits what made them, and adds nothing to it."""

    @staticmethod
    def forward(ctx: Any, *images: Tensor) -> Tensor:
        """Zero, a scalar.

        Args:
            *images: Of all renderings that other ranks take part in.
        """
        return images[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """No gradients."""
        return (None,) * len(ctx.needs_input_grad)
