"""Models in metres, east, north and up: GPS that is right, wrong in part, or of no use."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from flown_model import ORIGIN, Flight, flight, rows_at
from thermosplat.prepare.structure.placing import Placed, placed
from thermosplat.prepare.structure.positions import positions_of

NOISE = 0.5 * 3**0.5
"""Distance [m] by which one position is off."""


@pytest.fixture(scope="module")
def flown() -> Flight:
    return flight()


def located(flown: Flight, rows: list) -> tuple[Placed, np.ndarray]:
    """The placed model, and the distances [m] of its cameras from the truth, in the frame about its own origin."""
    positions = positions_of(rows, {})
    result = placed(flown.model, rows, positions)
    centres = np.array([image.projection_center() for _, image in sorted(result.model.images.items())])
    if result.geo is None:
        return result, np.array([])
    latitude, longitude, altitude = result.geo.latitude, result.geo.longitude, result.geo.altitude
    degrees = pycolmap.GPSTransform().enu_to_ellipsoid(centres, latitude, longitude, altitude)
    return result, np.linalg.norm(pycolmap.GPSTransform().ellipsoid_to_enu(degrees, *ORIGIN) - flown.places, axis=1)


def test_a_flight_lies_in_metres_where_gps_has_it(flown: Flight) -> None:
    """Cameras lie nearer to the truth than their positions do; the residual and the zone are said."""
    result, error = located(flown, flown.rows)
    assert error.max() < NOISE
    assert result.geo is not None
    assert 0.4 < result.geo.residual < 1.2
    assert "UTM zone 32N, EPSG:32632" in result.sentences[0]
    assert f"40 cameras lie {result.geo.residual:.2f} m from where GPS has them" in result.sentences[0]
    assert len(result.sentences) == 1
    assert flown.model.images[1].projection_center() != pytest.approx(result.model.images[1].projection_center())


@pytest.mark.parametrize("shift", [(6.0, 4.0, 0.0), (0.0, 0.0, 40.0), (300.0, -200.0, 20.0), (90_000.0, 0.0, 0.0)])
@pytest.mark.parametrize("together", [True, False])
def test_a_third_that_is_wrong_is_left_out_and_named(flown: Flight, shift: tuple, together: bool) -> None:
    """Off by a few metres, in height, by a street or by a country, all alike or each by itself."""
    generator = np.random.default_rng(1)
    wrong = np.arange(13) * 3
    moved = flown.gps.copy()
    signs = np.ones((13, 1)) if together else generator.choice([-1.0, 1.0], (13, 1)) * generator.uniform(1, 2, (13, 1))
    moved[wrong] += signs * shift
    rows = rows_at(moved)
    result, error = located(flown, rows)
    assert error.max() < NOISE
    assert "GPS is wrong by" in result.sentences[1]
    assert (
        "in 13 photographs, whose positions were left out: 001.jpg, 004.jpg, 007.jpg and 10 more" in result.sentences[1]
    )
    assert result.geo is not None
    assert result.geo.cameras == 27


def test_without_rtk_in_the_middle_the_fixed_ones_count(flown: Flight) -> None:
    """Twelve of forty lost their fix and lie 2 m off: the others hold the model to centimetres."""
    places = flown.places + np.random.default_rng(2).normal(0, 0.02, flown.places.shape)
    places[14:26] += [1.5, -1.0, 2.0]
    flags: list[object] = [16 if 14 <= number < 26 else 50 for number in range(40)]
    result, error = located(flown, rows_at(places, rtk_flag=flags))
    assert error.max() < 0.06
    assert result.geo is not None


def test_photographs_without_a_position_are_placed_with_the_others(flown: Flight) -> None:
    """Half of them have none."""
    places = flown.gps.copy()
    places[::2] = np.nan
    result, error = located(flown, rows_at(places))
    assert result.geo is not None
    assert result.geo.cameras == 20
    assert error.max() < NOISE


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        (lambda flown: [replace(row, altitude=None) for row in flown.rows], "have no altitude"),
        (
            lambda flown: [replace(row, latitude=None) if number > 2 else row for number, row in enumerate(flown.rows)],
            "are known of 3 photographs with a pose, and 4 are needed",
        ),
        (
            lambda flown: [replace(row, latitude=None) if number > 7 else row for number, row in enumerate(flown.rows)],
            "lie on one line, about which the model could turn",
        ),
        (lambda flown: rows_at(np.random.default_rng(3).uniform(-40, 40, (40, 3))), "do not fit the poses"),
    ],
)
def test_gps_that_says_too_little(flown: Flight, rows, why: str) -> None:
    """The model stays as it is, and the sentence says why."""
    result = placed(flown.model, made := rows(flown), positions_of(made, {}))
    assert result.geo is None
    assert result.model is flown.model
    assert result.sentences == (
        f"! GPS positions {why}: the model stays in units of its own, and maps in local coordinates.",
    )


def test_photographs_without_gps_stay_as_they_are(flown: Flight) -> None:
    """Nothing is said of it."""
    rows = [replace(row, latitude=None, longitude=None) for row in flown.rows]
    assert placed(flown.model, rows, positions_of(rows, {})) == Placed(flown.model, None, ())


def test_a_photograph_takes_the_position_of_its_thermal_image(flown: Flight) -> None:
    """A table may name thermal images alone."""
    rows = [replace(row, latitude=None, longitude=None, altitude=None) for row in flown.rows]
    thermal = {row.file: replace(row, spectrum="thermal") for row in flown.rows}
    np.testing.assert_allclose(positions_of(rows, thermal).places, positions_of(flown.rows, {}).places)


@pytest.mark.parametrize(("shrunk", "flag", "expected"), [(1.0, 16, True), (0.1, 16, False), (0.1, 50, True)])
def test_positions_that_lie_within_their_error_tell_no_neighbours(
    flown: Flight, shrunk: float, flag: int, expected: bool
) -> None:
    """A telephone's in a room do not, an RTK receiver's over a roof do."""
    flags: list[object] = [flag] * 40
    assert positions_of(rows_at(shrunk * flown.gps, rtk_flag=flags), {}).tell_neighbours == expected
    assert not positions_of(rows_at(np.full((40, 3), np.nan)), {}).tell_neighbours


def test_positions_that_are_right_are_priors(flown: Flight) -> None:
    """With the deviation that the fit shows, not the one that is assumed; a wrong one is none."""
    wrong = flown.gps.copy()
    wrong[4] += [200.0, 0.0, 0.0]
    result = placed(flown.model, rows := rows_at(wrong), positions := positions_of(rows, {}))
    assert [prior.pose_prior_id for prior in result.priors] == [n for n in range(1, 41) if n != 5]
    for prior in result.priors:
        np.testing.assert_allclose(prior.position, positions.places[prior.pose_prior_id - 1])
        assert 0.3 < np.sqrt(prior.position_covariance[0, 0]) < 0.7
