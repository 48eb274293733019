"""A map's temperatures beside what held-out images measured."""

import numpy as np

from bench_map import Measured, highest
from thermosplat.export.maps.map_frame import MapFrame
from thermosplat.export.maps.orthomosaic import MapGrid


def test_the_highest_point_of_each_pixel_counts() -> None:
    """Lower points of the same pixel do not, nor do those beside the map or above its top."""
    grid = MapGrid(MapFrame(np.eye(3)), west=0.0, north=2.0, pixel=1.0, width=2, height=2, top=5.0)
    places = [(0.5, 1.5, 1.0), (0.6, 1.4, 3.0), (1.5, 0.5, 2.0), (1.5, 0.5, 6.0), (2.5, 0.5, 1.0), (0.5, -0.1, 1.0)]
    chosen, row, column = highest(Measured(np.array(places), np.arange(6.0)), grid)
    assert chosen.tolist() == [1, 2]
    assert (row.tolist(), column.tolist()) == ([0, 1], [0, 1])
