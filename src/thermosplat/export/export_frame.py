"""The frame of exported files: the world of the capture, or UTM where the capture says where that lies on the Earth.

Positions of float32 have no digits for coordinates far from zero. There files count from a round origin, which
``geo.json`` beside them states: what is to be added.
"""

import json
import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.geo_file import GEO_FILE, GeoFrame
from thermosplat.datasets.placement import Placement
from thermosplat.export.splats import Splats, in_world
from thermosplat.runs.atomic_writes import write_text


@dataclass(frozen=True)
class ExportFrame:
    """Where exported positions count from.

    Args:
        placement: Where the scene lies in the world.
        geo: Where the world lies on the Earth; None: it is not known, and files have the world's axes.
    """

    placement: Placement
    geo: GeoFrame | None = None

    @cached_property
    def origin(self) -> tuple[float, float, float]:
        """What is to be added to positions in files."""
        if self.geo is None:
            return self.placement.origin
        east, north, up = self.geo.origin.tolist()
        return east, north, up

    def points(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Points of the world [M, 3] as tables of points have them: as they are, or metres from the origin in UTM."""
        return points if self.geo is None else (self.geo.to_utm(points) - self.origin).astype(np.float32)

    def splats(self, splats: Splats) -> Splats:
        """Gaussians of the scene as files have them, from the origin."""
        splats = in_world(splats, self.placement)
        if self.geo is None:
            return splats
        rotation, scale = self.geo.rotation, self.geo.scale
        shift = self.geo.to_utm(np.array(self.placement.origin)) - self.origin
        turn = torch.as_tensor(scale * rotation, dtype=torch.float64)
        means = splats.means.detach().double().cpu() @ turn.T + torch.as_tensor(shift)
        angle = math.atan2(rotation[1, 0], rotation[0, 0])
        return replace(
            splats,
            means=means.to(splats.means),
            quats=_turned_quats(splats.quats, angle),
            log_scales=splats.log_scales + math.log(scale),
            shN=_turned_harmonics(splats.shN, angle),
        )

    def comments(self) -> list[str]:
        """For headers of files whose positions count from the origin."""
        if self.geo is not None:
            return [f"origin {self._origin_text}: to be added to positions for EPSG:{self.geo.epsg}"]
        if self.placement.is_moved:
            return [f"origin {self._origin_text}: to be added to positions for those of the capture"]
        return []

    def write(self, folder: Path) -> list[str]:
        """Write ``geo.json``; nothing where positions are the world's own.

        Args:
            folder: Where the files are that it is about.

        Returns:
            What to tell people, in one line or none.
        """
        path = folder / GEO_FILE
        if self.geo is not None:
            about = f"EPSG:{self.geo.epsg} = positions in the files of splats, points and meshes here + origin"
            content = {"origin": list(self.origin), "epsg": self.geo.epsg, "utm_zone": self.geo.zone, "about": about}
            write_text(path, json.dumps(content, indent=1) + "\n")
            what = f"metres in UTM zone {self.geo.zone} from {self._origin_text}, as {path} says"
            return [f"Splats, points and meshes are in {what}; maps and LAS have the coordinates themselves."]
        if not self.placement.is_moved:
            return []
        about = "world coordinates, those of the capture's poses = positions in the files of splats here + origin"
        write_text(path, json.dumps({"origin": list(self.origin), "about": about}, indent=1) + "\n")
        return [f"Splats are stored relative to {self._origin_text}, as {path} says: float32 has no digits for more."]

    @property
    def _origin_text(self) -> str:
        return " ".join(repr(coordinate) for coordinate in self.origin)


def _turned_quats(quats: Tensor, angle: float) -> Tensor:
    """Rotations wxyz [N, 4] followed by a turn about z."""
    w, x, y, z = quats.unbind(dim=-1)
    c, s = math.cos(angle / 2), math.sin(angle / 2)
    return torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], dim=-1)


def _turned_harmonics(shN: Tensor, angle: float) -> Tensor:
    """Coefficients [N, K-1, 3] of colours that turn about z: orders m and -m of a degree mix, by the angle times m."""
    turned, degree = shN.clone(), 1
    while (degree + 1) ** 2 - 1 <= shN.shape[1]:
        middle = degree * (degree + 1) - 1  # of m = 0, and degree 0 is stored elsewhere
        for m in range(1, degree + 1):
            c, s = math.cos(m * angle), math.sin(m * angle)
            cosine, sine = shN[:, middle + m], shN[:, middle - m]
            turned[:, middle + m], turned[:, middle - m] = c * cosine - s * sine, s * cosine + c * sine
        degree += 1
    return turned
