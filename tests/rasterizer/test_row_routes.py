"""Routes of projected Gaussians: every row that a camera sees leaves once, and arrives where its camera looks."""

from pathlib import Path

import pytest
import torch

from ranks import group
from thermosplat.rasterizer.row_routes import Arrival, Route, route_in_room, route_of_seen

VISIBLE = torch.tensor([[1, 0, 1, 1, 0], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]], dtype=torch.bool)


def test_all_that_is_seen_leaves(tmp_path: Path) -> None:
    """One rank with three cameras: as many rows as each sees, places for the most that one sees."""
    with group(0, 1, str(tmp_path / "store")):
        route = route_of_seen(VISIBLE, [3])
    departures = list(route.departures())
    assert [numbers.tolist() for _, numbers, _ in departures] == [[0, 2, 3], [], [10, 11, 12, 13, 14]]
    assert [places.tolist() for _, _, places in departures] == [[0, -1, 1, 2, -1], [-1] * 5, [0, 1, 2, 3, 4]]
    assert list(route.arrivals()) == [Arrival(0, slice(0, 3)), Arrival(0, slice(5, 5)), Arrival(0, slice(10, 15))]
    assert route.seen == 5
    assert not route.is_full


@pytest.mark.parametrize("room", [2, 4, 7])
def test_a_room_is_filled_from_its_beginning(tmp_path: Path, room: int) -> None:
    """What finds no place is left out; a place that is left has no row."""
    with group(0, 1, str(tmp_path / "store")):
        route = route_in_room(VISIBLE, [3], room)
    for camera, (_, numbers, places) in enumerate(route.departures()):
        seen = (VISIBLE[camera].nonzero().squeeze(1) + camera * 5).tolist()[:room]
        assert numbers.tolist() == seen + [-1] * (room - len(seen))
        assert [place for place in places.tolist() if place >= 0] == list(range(len(seen)))
        assert [camera * 5 + i for i, place in enumerate(places.tolist()) if place >= 0] == seen
    assert route.seen == room
    assert route.is_full


def test_rows_of_one_camera_lie_together() -> None:
    """The first rank's before the second's, camera by camera."""
    none = torch.empty(0, dtype=torch.int32)
    route = Route(0, none, none, [[4, 4], [4]], [[4, 2], [5, 3]], 9)
    places = [(rank, where.start, where.stop) for rank, where in route.arrivals()]
    assert places == [(0, 0, 4), (0, 9, 11), (1, 4, 9), (1, 11, 14)]
    assert not route.is_full
