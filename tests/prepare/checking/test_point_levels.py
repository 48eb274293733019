"""Levels of thermal images by the points that several of them see."""

import numpy as np
import pytest

from flown_model import Flight, flight
from thermosplat.prepare.checking.findings import thermal_findings
from thermosplat.prepare.checking.point_levels import PointLevels, point_levels
from thermosplat.prepare.registration.rig_camera import RigCamera
from thermosplat.prepare.registration.rig_model import with_thermal

WIDTH, HEIGHT, FOCAL = 160, 128, 190.0


@pytest.fixture(scope="module")
def flown() -> Flight:
    return flight(points=1500)


def thermal_images(flown: Flight, levels: np.ndarray, noise: float) -> dict[str, np.ndarray]:
    """Ground from 10 °C in the west to 30 °C in the east with furrows, from straight above."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    generator = np.random.default_rng(0)
    images = {}
    for number, (place, level) in enumerate(zip(flown.places, levels), start=1):
        x, y = place[0] + u / FOCAL * place[2], place[1] - v / FOCAL * place[2]
        ground = 20.0 + x / 6.0 + 2.0 * np.sin(x / 2.0) * np.cos(y / 3.0)
        images[f"{number:03}.tiff"] = ground + level + generator.normal(0, noise, ground.shape)
    return images


def estimated(flown: Flight, levels: np.ndarray, noise: float = 0.05) -> PointLevels | None:
    camera = RigCamera.looking_along(WIDTH, HEIGHT, FOCAL)
    pairs = {row.file: row.file.replace("jpg", "tiff") for row in flown.rows}
    return point_levels(with_thermal(flown.model, camera, pairs), thermal_images(flown, levels, noise))


def test_levels_are_found_over_ground_of_all_temperatures(flown: Flight) -> None:
    """A drift of 0.2 K under images whose medians differ by kelvins: to 0.02 K, as the deviation says."""
    levels = np.cumsum(np.random.default_rng(3).normal(0, 0.1, 40))
    found = estimated(flown, levels)
    assert found is not None
    error = np.array(list(found.levels.values())) - (levels - levels.mean())
    assert np.abs(error).max() < 0.05
    assert error.std() < 0.02
    assert found.deviation < 0.02
    assert found.drift == pytest.approx(levels.std(), rel=0.05)


def test_reflections_bear_little(flown: Flight) -> None:
    """One value in ten is 15 K off in one half of the flight."""
    levels = np.zeros(40)
    camera = RigCamera.looking_along(WIDTH, HEIGHT, FOCAL)
    pairs = {row.file: row.file.replace("jpg", "tiff") for row in flown.rows}
    images = thermal_images(flown, levels, 0.05)
    for name in list(images)[:20]:
        images[name][np.random.default_rng(int(name[:3])).random((HEIGHT, WIDTH)) < 0.1] -= 15.0
    found = point_levels(with_thermal(flown.model, camera, pairs), images)
    assert found is not None
    assert found.drift < 0.15  # the mean shift of that half is 1.5 K


@pytest.mark.parametrize(("drift", "recommended"), [(0.0, False), (0.3, True)])
def test_drift_is_learnt_without_a_flag(flown: Flight, drift: float, recommended: bool) -> None:
    """Ground of many temperatures alone is no drift; drift is said as a fact, with the setting that helps."""
    levels = drift * np.sin(np.arange(40.0))
    images = thermal_images(flown, levels, 0.05)
    findings = thermal_findings(images, "°C", estimated(flown, levels))
    assert any("drifts by 0.2" in one.sentence for one in findings) == recommended
    settings = [one.recommends for one in findings if one.recommends]
    assert settings == ([{"spectra": {"thermal": {"exposure": "level"}}}] if recommended else [])
    assert all(one.level == "fact" for one in findings)


def test_a_model_of_photographs_alone_tells_nothing(flown: Flight) -> None:
    """No thermal image has a pose."""
    assert point_levels(flown.model, thermal_images(flown, np.zeros(40), 0.0)) is None
