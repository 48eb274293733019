"""What a run runs on: versions, device and threads, so that numbers can be traced to a machine."""

import importlib.metadata
import os
import platform
from typing import Any

import torch

from thermosplat import __version__
from thermosplat.runs.devices import device_name

_PACKAGES = ("torch", "warp-lang", "numpy", "kornia", "pycolmap", "opencv-contrib-python-headless")


def environment(device: torch.device) -> dict[str, Any]:
    """Versions, device and threads of this process; no paths."""
    versions: dict[str, str | None] = {"thermosplat": __version__}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    versions["torch"] = str(torch.__version__)  # names the build too (+cu124), which the metadata may not
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "packages": versions,
        "device": device_name(device),
        "cuda": torch.version.cuda if device.type == "cuda" else None,
        "cpu_cores": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
    }
