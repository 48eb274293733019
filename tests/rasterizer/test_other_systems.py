"""The rasterizer imports without what other systems or lean installations lack."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.rotating

LACKING = """
import os, random, signal, socket, sys
import torch, warp
for name in {modules!r}:
    sys.modules[name] = None
for owner, names in ((os, {of_os!r}), (signal, {of_signal!r}), (socket, {of_socket!r})):
    for name in names:
        delattr(owner, name)
from thermosplat import rasterization, rasterize_to_pixels
eye = torch.eye(3)[None]
image, _, _ = rasterization(
    torch.rand(5, 3), torch.rand(5, 4), torch.rand(5, 3), torch.rand(5), torch.rand(5, 3), torch.eye(4)[None], eye, 8, 8
)
assert image.shape == (1, 8, 8, 3)
"""

WINDOWS = {
    "modules": ("fcntl", "resource", "pwd", "grp", "termios"),
    "of_os": ("fork", "register_at_fork", "sched_getaffinity", "sysconf", "getuid", "O_NOFOLLOW", "O_DIRECTORY"),
    "of_signal": ("SIGHUP", "SIGPIPE", "pthread_sigmask"),
    "of_socket": ("AF_UNIX", "SOCK_SEQPACKET", "socketpair"),
}
MACOS = {"of_os": ("sched_getaffinity",)}
LEAN = {"modules": ("pycolmap", "cv2", "kornia")}


@pytest.mark.parametrize(
    "lacking", [WINDOWS, MACOS, LEAN], ids=["as on Windows", "as on macOS", "without pycolmap, OpenCV and kornia"]
)
def test_the_rasterizer_runs_without(lacking: dict[str, tuple[str, ...]]) -> None:
    """Nothing that docs/platforms.md says is missing somewhere is needed to render."""
    kinds = ("modules", "of_os", "of_signal", "of_socket")
    code = LACKING.format(**{kind: lacking.get(kind, ()) for kind in kinds})
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
