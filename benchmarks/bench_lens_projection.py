"""How far from the truth is a Gaussian behind a lens, when it is drawn as a Gaussian in the image?

    python benchmarks/bench_lens_projection.py --gaussians 24 --markdown lens-projection.md

The truth is traced in float64: through every pixel of a lens goes a ray, which the lens's formula is inverted for, and
the Gaussian's value there is its largest along the ray ("peak", 3DGUT's) or its integral along it, 1 at most
("integral"). Beside it two ways to draw it: the projection's Jacobian at the mean ("jacobian", EWA), and the unscented
transform with gsplat's parameters ("unscented"). No kernel is run: it is a choice of formulas. The error of a Gaussian
is |drawn - truth| / |truth| over all pixels, in percent; a row has the median and the 90th percentile. The lenses are
tests/fixtures/reference_lenses.py; Gaussians lie anywhere in the image, 1 to 4 units away, with axes of log-normal
lengths (σ 0.7).
"""

import argparse
import math
import platform
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "fixtures"))
from reference_lenses import Lens, image_points, jacobian, rays
from reference_projection import rotation_matrices
from thermosplat.runs.atomic_writes import write_text

WIDTH, HEIGHT = 320, 240
SIZES = (2.0, 6.0, 15.0)
"""Root of the area of a standard deviation in the image [px]."""

ALPHA, BETA = 0.1, 2.0
"""gsplat's parameters of the transform; its κ is 0."""

WAYS = ("jacobian", "unscented")


def coefficients(*values: float) -> Tensor:
    """Of one camera, [1, n]."""
    return torch.tensor([values], dtype=torch.float64)


FTHETA = SimpleNamespace(
    reference_poly=1,
    angle_to_pixeldist_poly=[0.0, 115.0, 1.0, -4.0, 0.5, 0.0],
    pixeldist_to_angle_poly=[0.0] * 6,
    max_angle=1.5,
    linear_cde=[1.01, 0.003, -0.002],
)

LENSES: dict[str, tuple[float, Lens]] = {
    "pinhole, 60 degrees wide": (277.0, Lens()),
    "thermal lens of rig_desk": (277.0, Lens(radial_coeffs=coefficients(-0.24, 0.07))),
    "barrel, 94 degrees": (150.0, Lens(radial_coeffs=coefficients(-0.28, 0.09, -0.01))),
    "rational, 102 degrees": (130.0, Lens(radial_coeffs=coefficients(0.8, 0.1, 0.005, 1.2, 0.35, 0.03))),
    "tangential and thin prism": (
        220.0,
        Lens("pinhole", coefficients(-0.2, 0.05), coefficients(0.02, -0.015), coefficients(0.02, 0.004, -0.015, 0.003)),
    ),
    "fisheye without coefficients, 150 degrees": (120.0, Lens("fisheye")),
    "fisheye, 150 degrees": (120.0, Lens("fisheye", coefficients(-0.03, 0.004, -0.002, 0.0003))),
    "f-theta, 160 degrees": (1.0, Lens("ftheta", ftheta_coeffs=FTHETA)),
}
"""Focal length [px] and lens, by name."""


def pixels() -> Tensor:
    """Centres of all pixels, [P, 2]."""
    x, y = torch.meshgrid(torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5, indexing="xy")
    return torch.stack([x, y], -1).reshape(-1, 2).double()


def traced(directions: Tensor, means: Tensor, axes: Tensor) -> dict[str, Tensor]:
    """True images of Gaussians along rays from the origin, each [n, P]; rows of ``axes`` [n, 3, 3] are axes."""
    precision = torch.linalg.inv(axes.transpose(1, 2) @ axes)
    weighted = torch.einsum("nij,nj->ni", precision, means)
    along = weighted @ directions.T
    length = torch.einsum("pi,nij,pj->np", directions, precision, directions)
    nearest = (means * weighted).sum(1)[:, None] - along.square() / length
    peak = torch.exp(-0.5 * nearest) * (along > 0)
    integral = peak * (directions.square().sum(1) / length).sqrt()
    return {"peak": peak, "integral": integral / integral.amax(1, keepdim=True)}


def drawn(K: Tensor, lens: Lens, means: Tensor, axes: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
    """Mean [n, 2] and covariance [n, 2, 2] in the image, by way."""

    def project(points: Tensor) -> Tensor:
        return image_points(points.reshape(1, -1, 3), K[None], lens)[0].reshape(*points.shape[:-1], 2)

    center = project(means)
    linear = axes @ jacobian(project, means).detach().transpose(1, 2)
    away = ALPHA * math.sqrt(3.0)
    above, below = project(means[:, None] + away * axes), project(means[:, None] - away * axes)
    slopes, bows = (above - below) / (2 * away), (above + below - 2 * center[:, None]) / away**2
    shift = bows.sum(1) / 2
    covariance = slopes.transpose(1, 2) @ slopes
    second = away**2 / 4 * bows.transpose(1, 2) @ bows + (BETA - ALPHA**2) * shift[:, :, None] * shift[:, None]
    return {
        "jacobian": (center, linear.transpose(1, 2) @ linear),
        "unscented": (center + shift, covariance + second),
    }


def errors(name: str, size: float, count: int, seed: int) -> dict[tuple[str, str], Tensor]:
    """Errors [n] in percent of Gaussians of one size behind a lens, by way and truth."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    focal, lens = LENSES[name]
    K = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    centers = pixels()
    directions = rays(centers, K, lens)
    found = (image_points(directions[None], K[None], lens)[0] - centers).norm(dim=1) < 1e-6
    centers, directions = centers[found], directions[found]  # a lens may not reach the corners
    chosen = directions[torch.randint(len(directions), (count,), generator=generator)]
    means = chosen / chosen.norm(dim=1, keepdim=True) * (1 + 3 * torch.rand(count, 1, generator=generator).double())
    quats = normal(count, 4)
    axes = torch.exp(0.7 * normal(count, 3))[..., None] * rotation_matrices(quats / quats.norm(dim=1, keepdim=True))
    _, covariance = drawn(K, lens, means, 1e-6 * axes)["jacobian"]
    axes = axes * (size * 1e-6 / torch.linalg.det(covariance) ** 0.25)[:, None, None]
    truths = traced(directions, means, axes)
    result = {}
    for way, (mean, covariance) in drawn(K, lens, means, axes).items():
        offsets = centers[None] - mean[:, None]
        power = torch.einsum("npi,nij,npj->np", offsets, torch.linalg.inv(covariance), offsets)
        for truth, image in truths.items():
            wrong = (torch.exp(-0.5 * power) - image).square().sum(1) / image.square().sum(1)
            result[way, truth] = 100 * wrong.sqrt()
    return result


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=24, help="per lens and size")
    parser.add_argument("--lenses", nargs="+", default=None, help="parts of names; all if not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--markdown", type=Path, default=None, help="file to write")
    options = parser.parse_args()
    columns = [(way, truth) for truth in ("peak", "integral") for way in WAYS]
    lines = [
        f"{time.strftime('%Y-%m-%d')}, {platform.machine()} CPU, torch {torch.__version__}, {options.gaussians} "
        f"Gaussians per row, seed {options.seed}. Median / 90th percentile of the error [%].",
        "",
        "| lens | size [px] | " + " | ".join(f"{truth}: {way}" for way, truth in columns) + " |",
        "|---|---|" + "---|" * len(columns),
    ]
    print("\n".join(lines), flush=True)
    for name in LENSES:
        if options.lenses is None or any(part in name for part in options.lenses):
            for size in SIZES:
                found = errors(name, size, options.gaussians, options.seed)
                cells = [f"{found[key].median():.2f} / {found[key].quantile(0.9):.1f}" for key in columns]
                lines.append(f"| {name} | {size:.0f} | " + " | ".join(cells) + " |")
                print(lines[-1], flush=True)
    if options.markdown is not None:
        write_text(options.markdown, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
