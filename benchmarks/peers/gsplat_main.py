"""gsplat's main branch, as a peer, from a folder of its own: two gsplats do not fit into one environment or process."""

import os
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from measuring.agreement import OTHER_CONVENTIONS
from peers.peer import Peer
from peers.renderers import gsplat_renderer

FOLDER = "THERMOSPLAT_GSPLAT_MAIN"
"""Environment variable: the folder that ``pip install --target`` put gsplat's main branch into."""


def gsplat_main_peer() -> Peer:
    """gsplat's main branch, of the folder that ``FOLDER`` names; alpha is clamped at 0.99 there.

    Raises:
        ImportError: the variable is not set, there is no gsplat in its folder, or another gsplat is imported already.
    """
    folder = os.environ.get(FOLDER)
    if not folder:
        raise ImportError(f"the environment variable {FOLDER} does not name its folder")
    if "gsplat" in sys.modules:
        raise ImportError("another gsplat is imported already")
    sys.path.insert(0, folder)
    try:
        gsplat: Any = import_module("gsplat")
    finally:
        sys.path.remove(folder)
    if not str(gsplat.__file__).startswith(os.path.abspath(folder)):
        raise ImportError(f"there is no gsplat in {folder}")
    renderer = gsplat_renderer(gsplat.rasterization, towards(gsplat.spherical_harmonics), packed=False)
    description = f"gsplat {gsplat.__version__} (main branch), CUDA kernels"
    return Peer("gsplat-main", description, renderer, tolerance=OTHER_CONVENTIONS)


def towards(spherical_harmonics: Callable[..., Tensor]) -> Callable[[int, Tensor, Tensor], Tensor]:
    """The main branch's function of means and cameras as one of directions: those of a camera at the origin."""

    def summed(degree: int, dirs: Tensor, coeffs: Tensor) -> Tensor:
        return spherical_harmonics(degree, dirs, torch.eye(4, dtype=dirs.dtype, device=dirs.device)[None], coeffs)[0]

    return summed
