"""The rasterizer imports without what other systems or lean installations lack."""

import subprocess
import sys

import pytest

LACKING = """
import os, random, sys
import torch
for name in {modules!r}:
    sys.modules[name] = None
if {forks!r}:
    del os.register_at_fork
from thermosplat import rasterization, rasterize_to_pixels
eye = torch.eye(3)[None]
image, _, _ = rasterization(
    torch.rand(5, 3), torch.rand(5, 4), torch.rand(5, 3), torch.rand(5), torch.rand(5, 3), torch.eye(4)[None], eye, 8, 8
)
assert image.shape == (1, 8, 8, 3)
"""


@pytest.mark.parametrize(
    ("modules", "forks"),
    [(("fcntl", "resource", "pwd", "grp"), True), (("pycolmap", "cv2", "kornia"), False)],
    ids=["as on Windows", "without pycolmap"],
)
def test_the_rasterizer_runs_without(modules: tuple[str, ...], forks: bool) -> None:
    """Nothing that docs/platforms.md says is missing somewhere is needed to render."""
    code = LACKING.format(modules=modules, forks=forks)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
