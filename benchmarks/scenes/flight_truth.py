"""What is known of a rendered flight: where its cameras were, and each place's temperature from straight above."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.colmap.similarity import similarity_by_weights

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FlightTruth:
    """truth.json and truth_map.npz of a flight; metres, x east, y north, z up."""

    centres: dict[str, Array]
    """Where each photograph was taken, by its file's stem."""
    celsius: NDArray[np.float32]
    """Apparent temperatures, row 0 north, column 0 west, the middle is the origin; [H, W]."""
    pixel: float
    """Side of a pixel [m]."""

    def placed(self, capture: Capture, leading: str, points: Array) -> tuple[Array, float]:
        """Points of a capture's world in the truth's frame, by the similarity of the cameras.

        Args:
            capture: Whose cameras are compared.
            leading: Spectrum of the photographs.
            points: [P, 3].

        Returns:
            The points [P, 3], and the median distance that is left between cameras [m].
        """
        pairs = []
        for frame in (*capture.train, *capture.test):
            view = frame.views.get(leading)
            true = self.centres.get(frame.name.rsplit("/", 1)[-1])
            if view is not None and true is not None:
                pairs.append((np.linalg.inv(view.viewmat)[:3, 3], true))
        ours, truth = (np.array(side) for side in zip(*pairs, strict=True))
        matrix = similarity_by_weights(ours, truth, np.ones(len(ours)))
        cameras, placed = (places @ matrix[:, :3].T + matrix[:, 3] for places in (ours, points))
        return placed, float(np.median(np.linalg.norm(cameras - truth, axis=1)))

    def at(self, places: Array) -> NDArray[np.float32]:
        """Temperatures of places [P, 3]; NaN outside the map."""
        height, width = self.celsius.shape
        column = places[:, 0] / self.pixel + width / 2 - 0.5
        row = height / 2 - 0.5 - places[:, 1] / self.pixel
        sampled = [axis.astype(np.float32)[:, None] for axis in (column, row)]
        parts = np.array_split(np.arange(len(places)), len(places) // 30000 + 1)  # remap takes 32,767 rows at most
        values = [
            cv2.remap(self.celsius, *(axis[part] for axis in sampled), cv2.INTER_LINEAR, borderValue=np.nan)
            for part in parts
        ]
        return np.concatenate(values)[:, 0]


def read_flight_truth(folder: Path) -> FlightTruth:
    """The truth of the flight in ``folder``."""
    told = json.loads((folder / "truth.json").read_text())
    poses = {Path(name).stem: np.array(pose) for name, pose in told["camera_to_world"].items()}
    with np.load(folder / "truth_map.npz") as file:
        return FlightTruth(
            {name: pose[:3, 3] for name, pose in poses.items()}, file["celsius"], float(file["metres_per_pixel"])
        )
