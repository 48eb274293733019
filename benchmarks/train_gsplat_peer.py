"""What does 3DGS reach when gsplat itself trains it? Its rasterizer, strategies and published constants.

    python benchmarks/train_gsplat_peer.py DATA [--spectra rgb thermal] [--max-steps 7000] [--seed 42] [--json F]
    python benchmarks/train_gsplat_peer.py DATA --strategy mcmc --cap-max 300000 --max-steps 30000

Each spectrum alone, on this project's loader, split and metrics, so that only renderer and training differ from
``thermosplat-train DATA --config 3dgs``. Needs CUDA and gsplat. The schedule is gsplat's examples/simple_trainer.py.

DefaultStrategy has no limit of Gaussians. MCMCStrategy adds 5% every 100 steps up to one, for equal numbers of them:
from 1,475 points it takes 11,500 steps to 300,000.
"""

import argparse
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)
import torch
from gsplat import rasterization
from gsplat.strategy import DefaultStrategy, MCMCStrategy
from torch import Tensor

from thermosplat.datasets import load_capture
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.image_quality.metrics import psnr, ssim
from thermosplat.losses.image_terms import image_loss
from thermosplat.runs.atomic_writes import write_text
from thermosplat.scene.neighbor_distances import neighbor_distances

SH_C0 = 0.28209479177387814


@dataclass(frozen=True)
class Published:
    """What gsplat's examples/simple_trainer.py sets for a strategy.

    Args:
        opacity: Of the first Gaussians.
        size: Of the first Gaussians, as a multiple of the distance to their neighbours.
        opacity_reg: Weight of the mean opacity in the loss.
        scale_reg: Weight of the mean scale in the loss, in units of the normalised capture.
    """

    opacity: float
    size: float
    opacity_reg: float
    scale_reg: float


PUBLISHED = {"default": Published(0.1, 1.0, 0.0, 0.0), "mcmc": Published(0.5, 0.1, 0.01, 0.01)}
"""By strategy."""


def normalized_unit(viewmats: Tensor) -> float:
    """The length [world units] that is 1 where gsplat's trainer has normalised the capture.

    It is the median distance of the cameras from what they look at: the median of the points on their optical axes that
    are nearest to the origin. gsplat turns the world's axes first, which matters to a median by coordinates: 0.1% on
    the capture lund. MCMCStrategy's noise and the penalty on scales depend on this unit, and the near plane, which is
    left at 0.01 world units here.

    Args:
        viewmats: World to camera, shape [C, 4, 4].
    """
    to_world = torch.linalg.inv(viewmats.double().cpu())
    centers, axes = to_world[:, :3, 3], to_world[:, :3, 2]
    nearest = centers - (axes * centers).sum(1, keepdim=True) * axes
    focus = nearest.quantile(0.5, dim=0)
    return float((centers - focus).norm(dim=1).quantile(0.5))


def initial_parameters(points, colors, device, published=PUBLISHED["default"]) -> torch.nn.ParameterDict:
    """gsplat's: point colours, RMS distance to three neighbours, random rotations, SH degree 3."""
    points = torch.tensor(points, dtype=torch.float32)  # a copy: training moves it
    rgb = torch.as_tensor(colors, dtype=torch.float32) / 255
    distance = torch.as_tensor(neighbor_distances(points.numpy()), dtype=torch.float32)
    n = len(points)
    parameters = {
        "means": points,
        "scales": (published.size * distance).log().unsqueeze(-1).repeat(1, 3),
        "quats": torch.rand(n, 4),
        "opacities": torch.logit(torch.full((n,), published.opacity)),
        "sh0": ((rgb - 0.5) / SH_C0)[:, None],
        "shN": torch.zeros(n, 15, 3),
    }
    return torch.nn.ParameterDict({k: torch.nn.Parameter(v.to(device)) for k, v in parameters.items()})


def published_optimizers(params: torch.nn.ParameterDict, scene_scale: float) -> dict[str, torch.optim.Adam]:
    """One fused Adam a parameter, at the rates of gsplat's examples/simple_trainer.py."""
    rates = {
        "means": 1.6e-4 * scene_scale, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3,
        "shN": 2.5e-3 / 20,
    }  # fmt: skip
    return {k: torch.optim.Adam([params[k]], lr=lr, eps=1e-15, fused=True) for k, lr in rates.items()}


def render(params: torch.nn.ParameterDict, view: ViewTensors, degree: int) -> tuple[Tensor, Tensor, dict]:
    """gsplat's image [1, H, W, 3], accumulated opacity and dictionary of a view, at an active SH degree."""
    return rasterization(
        params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
        torch.cat([params["sh0"], params["shN"]], 1), view.viewmat[None], view.K[None], view.width, view.height,
        sh_degree=degree, packed=False,
    )  # fmt: skip


def train(
    capture, spectrum: str, max_steps: int, scene_scale: float, seed: int, device: torch.device,
    cap_max: int | None = None,
) -> dict:  # fmt: skip
    """Trains one spectrum; returns held-out PSNR, SSIM, count and seconds. MCMCStrategy where there is a cap_max."""
    torch.manual_seed(seed)
    views = [
        [view_tensors(frame.views[spectrum], None, device) for frame in frames if spectrum in frame.views]
        for frames in (capture.train, capture.test)
    ]
    named = "default" if cap_max is None else "mcmc"
    published = PUBLISHED[named]
    params = initial_parameters(capture.points, capture.point_colors, device, published)
    optimizers = published_optimizers(params, scene_scale)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], 0.01 ** (1 / max_steps))
    strategy = DefaultStrategy() if cap_max is None else MCMCStrategy(cap_max=cap_max)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(**({"scene_scale": scene_scale} if cap_max is None else {}))
    unit = normalized_unit(torch.stack([view.viewmat for half in views for view in half]))

    order, started = [], time.perf_counter()
    for step in range(max_steps):
        if not order:
            order = torch.randperm(len(views[0])).tolist()
        view = views[0][order.pop()]
        image, _, info = render(params, view, min(step // 1000, 3))
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = image_loss(image[0], view.image, 0.2)
        if published.opacity_reg > 0:
            loss = loss + published.opacity_reg * params["opacities"].sigmoid().mean()
        if published.scale_reg > 0:
            loss = loss + published.scale_reg / unit * params["scales"].exp().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        schedule.step()
        if cap_max is None:
            strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
        else:  # noise is covariance x rate: cubic in the unit of length, where means are linear
            rate = schedule.get_last_lr()[0] / unit**2
            strategy.step_post_backward(params, optimizers, state, step, info, lr=rate)
    torch.cuda.synchronize()
    seconds = time.perf_counter() - started
    with torch.no_grad():
        pairs = [(render(params, view, 3)[0][0], view.image) for view in views[1]]
    return {
        "spectrum": spectrum,
        "strategy": named,
        "psnr": sum(psnr(*pair) for pair in pairs) / len(pairs),
        "ssim": sum(ssim(*pair) for pair in pairs) / len(pairs),
        "num_gaussians": len(params["means"]),
        "seconds": seconds,
        "scene_scale": scene_scale,
        "seed": seed,
        "steps": max_steps,
    }


def main() -> None:
    """Parses arguments, trains, prints and saves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data")
    parser.add_argument("--spectra", "--modality", nargs="+", help="default: rgb and thermal, if the capture has them")
    parser.add_argument("--max-steps", type=int, default=7000)
    parser.add_argument("--scene-scale", type=float, default=math.nan, help="default: as gsplat, 1.1 x camera radius")
    parser.add_argument("--strategy", choices=sorted(PUBLISHED), default="default")
    parser.add_argument("--cap-max", type=int, help="most Gaussians; mcmc alone, there a million by default as gsplat")
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if args.strategy == "default" and args.cap_max is not None:
        parser.error("--cap-max goes with --strategy mcmc: gsplat's DefaultStrategy has no limit.")
    cap_max = None if args.strategy == "default" else args.cap_max or 1_000_000
    capture = load_capture(args.data)
    scale = capture.scene_extent if math.isnan(args.scene_scale) else args.scene_scale
    there = [name for name in ("rgb", "thermal") if any(name in frame.views for frame in capture.train)]
    rows = []
    for spectrum in args.spectra or there:
        result = train(capture, spectrum, args.max_steps, scale, args.seed, torch.device("cuda"), cap_max)
        rows.append({"capture": capture.name} | result)
        print(rows[-1], flush=True)
        if args.json:
            write_text(args.json, json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
