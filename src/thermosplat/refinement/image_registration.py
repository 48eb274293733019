"""Cameras beyond the first spectrum's, moved until what they see of the scene lies on their images.

The photographs fix the scene's shape. So the rig and the lenses of all other spectra are a few numbers that all their
images together determine, on the scene as it is at that time. Each round of Gauss-Newton solves

    (Gᵀ W T) dz = -Gᵀ W r

for a camera's coordinates z (preconditioning.py). r is the difference of slopes, of the rendered image less those of
the taken one. G and T are the derivatives of the rendered and of the taken slopes by z: the flow of every pixel, which
the rendered depth gives, times the image's own slope. Four things make this right on a scene that is not finished,
where the gradient of the training loss is not (benchmarks/records/refinement.md):

- Rendered images are divided by their accumulated opacity, and pixels weigh by it. Else a scene that thins out towards
  the border draws the focal length up.
- Slopes are compared, not values, after a blur that becomes finer with time.
- Large differences weigh little: w = 1 / (1 + (r / s)²), s from the median of |r| (Cauchy). Close to the true camera s
  is small. The photographs' shape leaves thermal images differences that no camera explains, and they move it.
- T in place of a second G (an instrumental variable): structure that only one of the two images has does not shorten
  the step.

The colours of the scene, learnt through the wrong camera, follow it late. So dz keeps going: z moves by
v = momentum v + dz (Polyak 1964).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.func import functional_call
from torch.nn.functional import conv2d, max_pool2d, pad

from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors
from thermosplat.distributed.team import Team
from thermosplat.refinement.camera_corrections import CameraCorrections
from thermosplat.refinement.camera_motion import seen_points
from thermosplat.scene.lens_distortion import undistorted_positions
from thermosplat.scene.lens_slopes import straightened
from thermosplat.scene.model import SceneModel

LOOKED_AT = 16
"""Frames per round, spread over all; the next round takes others. Open choice."""
LONGEST = 0.02
"""Longest step of a coordinate [image widths]. Open choice."""
FEWEST = 50
"""Weight, in pixels, below which images say nothing of a camera."""
_LEAST = 1e-3
"""Least s: a quarter of a level of 8 bits."""
_DAMPING = 1e-3
_FAINTEST = 0.1
_STEP = 0.5


class Frames(Protocol):
    """The training frames as the capture has them."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> FrameTensors: ...


@dataclass(frozen=True)
class Sharpness:
    """How images are compared in a round."""

    blur: float
    """Standard deviation of the blur [image widths]; at least one pixel."""
    tolerance: float
    """s, in medians of |r|; at least a quarter of a level of 8 bits."""
    momentum: float
    """Share of the last step that is taken again."""
    distortion: bool = False
    """Whether distortion changes, too; before the direction is about right, it would make up for that."""


Stages = tuple[tuple[float, Sharpness | None], ...]
"""Up to which share of a pass images are compared how; None: not at all, the scene is too young."""
PASSES: tuple[Stages, ...] = (
    (
        (0.125, Sharpness(0.02, 20.0, 0.0)),
        (0.3, Sharpness(0.0125, 20.0, 0.0)),
        (0.6, Sharpness(0.0, 6.0, 0.8)),
        (1.0, Sharpness(0.0, 1.5, 0.5)),
    ),
    (
        (0.3, None),
        (0.6, Sharpness(0.0, 1.5, 0.3)),
        (1.0, Sharpness(0.0, 1.5, 0.3, distortion=True)),
    ),
)
"""The first pass begins with wrong cameras, the second with some that are nearly right. Open choices, measured on
rig_desk (benchmarks/records/refinement.md)."""


def sharpness_at(number: int, share: float) -> Sharpness | None:
    """How images are compared.

    Args:
        number: Which pass, from 0.
        share: How much of its rounds is done, 0 to 1.
    """
    stages = PASSES[number]
    return next((sharpness for until, sharpness in stages if share < until), stages[-1][1])


class Equations(NamedTuple):
    """What images say of a camera's n free coordinates; those of several views are added up. All are float64."""

    of_both: Tensor
    """Gᵀ W T, shape [n, n]."""
    of_rendered: Tensor
    """Gᵀ W G, shape [n, n]."""
    slope: Tensor
    """Gᵀ W r, shape [n]."""
    weight: Tensor
    """Sum of W [px], a scalar."""


@torch.no_grad()
def register_cameras(
    model: SceneModel,
    corrections: CameraCorrections,
    frames: Frames,
    turn: int,
    sharpness: Sharpness,
    sh_degree: int,
    team: Team | None = None,
) -> None:
    """One round: each camera beyond the first spectrum's takes a step towards where its images were taken from.

    Args:
        model: The scene, or this rank's share of it; it stays as it is.
        corrections: Whose cameras move, in place.
        turn: Number of the round; it says which frames are looked at.
        team: The ranks that share the scene, all of which take the same step; None: there is one.
    """
    rank, ranks = (0, 1) if team is None else (team.rank, team.size)
    for number in corrections.registered:
        taken = corrections.frames_of(number)
        stride = -(-len(taken) // LOOKED_AT)
        looked_at = taken[turn % stride :: stride]
        views = []
        for start in range(0, len(looked_at), ranks):
            is_left = start + rank < len(looked_at)
            # a rank that has no frame left renders the last one, too: the others see its Gaussians by that
            frame = frames[looked_at[start + rank if is_left else -1]]
            found = _equations(model, corrections, frame, number, sharpness, sh_degree, distributed=ranks > 1)
            views.append(found if is_left else Equations(*map(torch.zeros_like, found)))
        total = Equations(*(torch.stack(parts).sum(dim=0) for parts in zip(*views, strict=True)))
        if team is not None:
            team.sum_in_place(total)
        of_both, of_rendered, slope, weight = (part.cpu() for part in total)
        if weight >= FEWEST:
            # where the two images have nothing in common yet, those of the rendered one
            normal = of_both if bool((of_both.diagonal() > 0).all()) else of_rendered
            within = corrections.directions(number, distortion=sharpness.distortion).double().cpu()
            _step(corrections, number, within, normal, slope, sharpness.momentum)


def _step(
    corrections: CameraCorrections, number: int, within: Tensor, normal: Tensor, slope: Tensor, momentum: float
) -> None:
    """Move a camera by the solution of its equations within some directions, and by what is left of the last step."""
    if within.shape[1] == 0:
        return
    normal, slope = within.T @ normal @ within, within.T @ slope
    damped = normal + _DAMPING * normal.diagonal().diag()
    found = within @ torch.linalg.lstsq(damped, -slope[:, None], driver="gelsd").solution[:, 0]
    if not bool(found.isfinite().all()):
        return
    longest = LONGEST * corrections.shared[number].camera.width
    velocity, free = corrections.velocity[number], list(corrections.free_coordinates(number))
    velocity[free] = _shortened(momentum * velocity[free] + _shortened(found, longest).to(velocity), longest)
    corrections.cameras[number] += velocity


def _shortened(step: Tensor, longest: float) -> Tensor:
    return step * (longest / step.abs().max().clamp(min=longest))


def _equations(
    model: SceneModel,
    corrections: CameraCorrections,
    frame: FrameTensors,
    number: int,
    sharpness: Sharpness,
    sh_degree: int,
    *,
    distributed: bool,
) -> Equations:
    """What one view says of a camera."""
    spectrum, free = corrections.shared[number].spectrum, corrections.free_coordinates(number)
    frame = replace(frame.only((spectrum,)), memory=None)
    view = corrections(frame).views[spectrum]
    if view.image is None:
        raise ValueError(f"Frame {frame.name} has no image of {spectrum}.")
    group = ((spectrum,),)
    rendered = model.render({spectrum: view}, sh_degree=sh_degree, shared_cameras=group, distributed=distributed)
    alpha = rendered.alphas[spectrum][..., 0]
    depth = model.render_depth(spectrum, view, expected=True, distributed=distributed)
    seen = rendered.images[spectrum].mean(dim=-1) / alpha.clamp(min=_FAINTEST)
    sigma = max(1.0, sharpness.blur * view.width)
    images = _blurred(torch.stack([seen, view.image.mean(dim=-1)]), sigma)
    flow = _flow(corrections, frame, number, free, spectrum, _points(view, depth))
    flow = flow.reshape(*depth.shape, 2, len(free))
    dx, dy = _slopes(images)
    moved = [-(dx[k, ..., None] * flow[..., 0, :] + dy[k, ..., None] * flow[..., 1, :]) for k in (0, 1)]
    by_rendered, by_taken = (_interior(torch.stack(_slopes(m.permute(2, 0, 1)), dim=-1)) for m in moved)
    difference = _interior(torch.stack(_slopes(images[:1] - images[1:]), dim=-1))
    reach = min(round(2 * sigma), (min(depth.shape) - 1) // 4)
    covers = alpha.square() * (depth > 0)
    if view.mask is not None:
        covers = covers * view.mask
    covered = -max_pool2d(-covers[None, None], 2 * reach + 1, 1, reach)[0]
    weight = _interior(covered[..., None].expand(-1, -1, -1, 2))
    scale = (sharpness.tolerance * difference.abs().median()).clamp(min=_LEAST)
    weight = (weight / (1.0 + (difference / scale).square()))[0].double()
    G, T = by_rendered.double(), by_taken.double()
    weighted = G * weight
    return Equations(weighted @ T.T, weighted @ G.T, weighted @ difference[0].double(), weight.sum() / 2)


def _points(view: ViewTensors, depth: Tensor) -> Tensor:
    """What the pixels of a view show [world units], shape [H W, 3]."""
    height, width = depth.shape
    none = view.K.new_zeros(2)
    pixels = undistorted_positions(height, width, view.K, none if view.distortion is None else view.distortion)
    directions = (pixels - view.K[:2, 2]) / view.K.diagonal()[:2]
    if view.lens is not None:
        directions = straightened(directions, view)
    rays = torch.cat([directions, torch.ones_like(directions[..., :1])], dim=-1).reshape(-1, 3)
    return (depth.reshape(-1, 1) * rays - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]


def _flow(
    corrections: CameraCorrections,
    frame: FrameTensors,
    number: int,
    free: Sequence[int],
    spectrum: str,
    points: Tensor,
) -> Tensor:
    """How points move in the image [px] by each free coordinate of a camera, shape [M, 2, len(free)]."""
    columns = []
    for coordinate in free:
        ends = []
        for step in (_STEP, -_STEP):
            cameras = corrections.cameras.clone()
            cameras[number, coordinate] += step
            moved = functional_call(corrections, {"cameras": cameras}, (frame,))
            ends.append(seen_points(moved.views[spectrum], points))
        columns.append((ends[0] - ends[1]) / (2 * _STEP))
    return torch.stack(columns, dim=-1).nan_to_num(0.0, 0.0, 0.0)


def _slopes(images: Tensor) -> tuple[Tensor, Tensor]:
    """Central differences across and down of images [N, H, W], zero on the border."""
    across, down = torch.zeros_like(images), torch.zeros_like(images)
    across[..., 1:-1] = (images[..., 2:] - images[..., :-2]) / 2
    down[..., 1:-1, :] = (images[..., 2:, :] - images[..., :-2, :]) / 2
    return across, down


def _interior(values: Tensor) -> Tensor:
    """[N, H, W, 2] without what differences of differences cannot tell at the border, flattened to [N, M]."""
    return values[:, 2:-2, 2:-2].flatten(start_dim=1)


def _blurred(images: Tensor, sigma: float) -> Tensor:
    """Images [N, H, W] under a Gaussian blur [px]; the border goes on."""
    reach = round(3 * sigma)
    places = torch.arange(-reach, reach + 1, dtype=images.dtype, device=images.device)
    window = torch.exp(-places.square() / (2 * sigma**2))
    window = window / window.sum()
    across = conv2d(pad(images[:, None], (reach, reach, 0, 0), mode="replicate"), window.view(1, 1, 1, -1))
    return conv2d(pad(across, (0, 0, reach, reach), mode="replicate"), window.view(1, 1, -1, 1))[:, 0]
