"""The catalogue of scenes that break rasterizers, for the tests and for benchmarks/bench_accuracy.py.

Each scene holds keyword arguments of ``rasterization`` as float64 tensors whose values float32 holds exactly, so that
every precision is given the very same numbers.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from gaussian_scenes import Scene, random_scene

FINITE: dict[str, Callable[[], Scene]] = {}
"""Scenes of finite numbers, by name."""

NON_FINITE: dict[str, Callable[[], Scene]] = {}
"""Scenes in which a quarter of the Gaussians hold a NaN or an infinity in one of the inputs, by name."""

LARGE = ("8K image",)
"""Scenes with too many pixels for the dense reference."""

ON_THRESHOLDS = ("means on and behind the near plane", "alpha at 1/255 and 0.999")
"""Scenes that lie on thresholds with numbers that float32 computes exactly: none of their pixels is uncertain."""


def hard_scene(name: str) -> Scene:
    """Builds the scene of this name.

    Raises:
        KeyError: if there is none.
    """
    scene = {**FINITE, **NON_FINITE}[name]()
    return {key: value.float().double() if isinstance(value, Tensor) else value for key, value in scene.items()}


def _finite(name: str) -> Callable[[Callable[[], Scene]], Callable[[], Scene]]:
    def register(build: Callable[[], Scene]) -> Callable[[], Scene]:
        FINITE[name] = build
        return build

    return register


def _ordinary(n: int = 60, width: int = 40, height: int = 30, **arguments: object) -> Scene:
    return random_scene(n=n, width=width, height=height, **arguments)  # type: ignore[arg-type]


def _axis_aligned(scene: Scene, focal: float | None = None) -> Scene:
    """Puts the camera at the origin, so that camera and world coordinates agree."""
    scene["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    if focal is not None:
        scene["Ks"][..., 0, 0] = scene["Ks"][..., 1, 1] = focal
    return scene


FINITE["ordinary"] = _ordinary
FINITE["ordinary, antialiased"] = partial(_ordinary, rasterize_mode="antialiased")
FINITE["ordinary, SH degree 3"] = partial(_ordinary, sh_degree=3)
FINITE["ordinary, expected depth"] = partial(_ordinary, render_mode="RGB+ED")


@_finite("needles, axis ratio 1e6")
def _needles() -> Scene:
    scene = _ordinary()
    scene["scales"] = scene["scales"] * torch.tensor([3.0, 3e-6, 3e-6])
    return scene


@_finite("pancakes, axis ratio 1e6")
def _pancakes() -> Scene:
    scene = _ordinary()
    scene["scales"] = scene["scales"] * torch.tensor([2.0, 2.0, 2e-6])
    return scene


@_finite("pancakes, antialiased")
def _pancakes_antialiased() -> Scene:
    return _pancakes() | {"rasterize_mode": "antialiased"}


@_finite("needles of 500 px")
def _long_needles() -> Scene:
    scene = _ordinary(width=320, height=240, n=24)
    scene["scales"] = torch.tensor([2.0, 2e-6, 2e-6], dtype=torch.float64).expand(24, 3).clone()
    return scene


@_finite("smaller than a pixel")
def _sub_pixel() -> Scene:
    scene = _ordinary(n=400)
    scene["scales"] = scene["scales"] * 1e-3
    return scene


@_finite("smaller than a pixel, antialiased")
def _sub_pixel_antialiased() -> Scene:
    scene = _ordinary(n=400, rasterize_mode="antialiased")
    scene["scales"] = scene["scales"] * 0.02
    return scene


@_finite("zero scales")
def _zero_scales() -> Scene:
    scene = _ordinary()
    scene["scales"][::3, 0] = 0.0
    scene["scales"][1::3, :2] = 0.0
    scene["scales"][2::6] = 0.0
    return scene


@_finite("zero scales, antialiased")
def _zero_scales_antialiased() -> Scene:
    return _zero_scales() | {"rasterize_mode": "antialiased"}


@_finite("larger than the image")
def _huge() -> Scene:
    scene = _ordinary()
    scene["scales"][::10] = 1000.0
    scene["opacities"][::10] = 0.2
    return scene


@_finite("camera inside Gaussians")
def _inside() -> Scene:
    scene = _ordinary()
    position, forward = torch.linalg.inv(scene["viewmats"])[0, :3, 3], scene["viewmats"][0, 2, :3]
    scene["means"][:10] = position + torch.linspace(0.02, 0.5, 10)[:, None] * forward
    scene["scales"][:10] = 0.5 + scene["scales"][:10]
    scene["opacities"][:10] *= 0.3
    return scene


@_finite("means on and behind the near plane")
def _near_plane() -> Scene:
    near = 2.0**-6  # the same number in every precision
    scene = _axis_aligned(_ordinary(near_plane=near))
    depth = torch.linspace(-1.0, 1.0, 60, dtype=torch.float64)
    depth[::6] = near
    depth[1::6] = 1.01 * near
    depth[2::6] = 0.999 * near
    scene["means"] = scene["means"] * depth[:, None].abs()
    scene["means"][:, 2] = depth
    scene["means"][3, 2] = 0.0
    scene["means"][4] = 0.0
    return scene


def _crowd(opacities: tuple[float, float]) -> Scene:
    """5,000 layers over every pixel, nearest last in index order, at depths float32 tells apart."""
    n = 5000
    scene = _axis_aligned(_ordinary(n=n, width=6, height=4))
    scene["means"][:, :2] *= 0.3
    scene["means"][:, 2] = torch.linspace(3.0, 5.0, n, dtype=torch.float64).flip(0)
    scene["scales"] = scene["scales"] + 3.0  # so that few of them fall to 1/255 within the image
    low, high = opacities
    scene["opacities"] = low + (high - low) * scene["opacities"]
    return scene


FINITE["5,000 over a pixel, opacity 0.004 to 0.008"] = partial(_crowd, (0.004, 0.008))
FINITE["5,000 over a pixel, opacity 0.001 to 0.02"] = partial(_crowd, (0.001, 0.02))
FINITE["5,000 over a pixel, opacity 0 to 1"] = partial(_crowd, (0.0, 1.0))


@_finite("opacity exactly 0 and 1")
def _extreme_opacities() -> Scene:
    scene = _ordinary()
    scene["opacities"][::3] = 0.0
    scene["opacities"][1::3] = 1.0
    return scene


@_finite("alpha at 1/255 and 0.999")
def _alpha_thresholds() -> Scene:
    """Gaussians centred on pixel centres, whose opacity is a threshold of the blend or the next number to it."""
    scene = _axis_aligned(_ordinary(n=24, width=40, height=30), focal=32.0)
    scene["Ks"][0, :2, 2] = torch.tensor([20.0, 15.0])
    columns, rows = torch.meshgrid(torch.arange(6.0), torch.arange(4.0), indexing="ij")
    centres = torch.stack([columns * 6 - 15.5, rows * 6 - 9.5], -1).reshape(24, 2).double()
    scene["means"] = torch.cat([centres / 8, torch.full((24, 1), 4.0)], -1)
    scene["scales"] = 0.05 + 0.5 * scene["scales"]
    at = torch.tensor([1 / 255, 0.999, 1.0, 0.5])
    around = torch.stack([at, at.nextafter(torch.zeros(4)), at.nextafter(torch.ones(4))]).flatten()
    scene["opacities"] = around.repeat(2).double()
    return scene


@_finite("equal depths")
def _equal_depths() -> Scene:
    scene = _axis_aligned(_ordinary())
    scene["means"][:, 2] = 4.0
    scene["means"][30:] = scene["means"][:30]
    return scene


@_finite("zero, denormal and long quaternions")
def _quaternions() -> Scene:
    scene = _ordinary()
    scene["quats"][::5] = 0.0
    scene["quats"][1::5] *= 1e-40
    scene["quats"][2::5] *= 1e-9
    scene["quats"][3::5] *= 1e15
    return scene


@_finite("1e6 from the origin")
def _far_away() -> Scene:
    scene = _ordinary()
    # Beyond 2^19 float32 has steps of 1/16: both the scene and the camera are rounded to them, together.
    scene["means"] = (scene["means"] * 16).round() / 16 * 8
    scene["scales"] = scene["scales"] * 8
    shift = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    scene["means"] = scene["means"] + shift
    scene["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    scene["viewmats"][0, :3, 3] = torch.tensor([0.0, 0.0, 32.0]) - shift
    return scene


@_finite("1e6 from the origin, turned, SH degree 3")
def _far_away_turned() -> Scene:
    """A turned camera: its matrix is rounded to float32, which moves the camera by a unit or so for all alike."""
    scene = _ordinary(sh_degree=3)
    shift = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    rotation = scene["viewmats"][0, :3, :3].float().double()
    translation = (torch.tensor([0.0, 0.0, 32.0]) - rotation @ shift).float().double()
    scene["viewmats"][0, :3, :3], scene["viewmats"][0, :3, 3] = rotation, translation
    # Gaussians are placed around where the rounded camera looks.
    middle = torch.linalg.solve(rotation, torch.tensor([0.0, 0.0, 32.0], dtype=torch.float64) - translation)
    scene["means"] = middle + 8 * scene["means"]
    scene["scales"] = scene["scales"] * 8
    return scene


@_finite("focal length of 1e5 px")
def _telephoto() -> Scene:
    scene = _axis_aligned(_ordinary(), focal=1e5)
    scene["means"] = scene["means"] * torch.tensor([0.8, 0.8, 500.0])
    scene["means"][:, 2] += 1e4
    return scene


@_finite("1-pixel image")
def _one_pixel() -> Scene:
    return _ordinary(width=1, height=1)


@_finite("8K image")
def _eight_k() -> Scene:
    """A few hundred Gaussians of up to some ten pixels, out to the last corner."""
    n, width, height = 400, 7680, 4320
    scene = _axis_aligned(random_scene(n=n, width=width, height=height), focal=5000.0)
    generator = torch.Generator().manual_seed(11)
    depth = 2.0 + 6.0 * torch.rand(n, generator=generator).double()
    pixels = torch.rand(n, 2, generator=generator).double() * torch.tensor([width, height])
    pixels[0], pixels[1] = torch.tensor([7679.5, 4319.5]), torch.tensor([0.5, 0.5])
    centre = scene["Ks"][0, :2, 2]
    scene["means"] = torch.cat([(pixels - centre) / 5000.0 * depth[:, None], depth[:, None]], -1)
    scene["scales"] = scene["scales"] * 0.02 * depth[:, None] / 4
    return scene


@_finite("scales from 1e-30 to 1e8")
def _any_scale() -> Scene:
    scene = _ordinary()
    scene["scales"] = scene["scales"] * 10 ** torch.linspace(-30, 8, 60).double()[:, None]
    return scene


def _with_bad_numbers(name: str, value: float) -> Scene:
    scene = _ordinary(with_covars=name == "covars")
    scene[name].view(60, -1)[::4, -1] = value
    return scene


for _name in ("means", "quats", "scales", "covars", "opacities", "colors"):
    for _value in (float("nan"), float("inf"), float("-inf")):
        NON_FINITE[f"{_value} in {_name}"] = partial(_with_bad_numbers, _name, _value)
