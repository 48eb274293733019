"""Captures that train without a word and come out wrong: one thing is changed in a good one, and that is said."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.prepare.checking.findings import recommended_by
from thermosplat.prepare.checking.plausible_temperatures import temperature_notes
from thermosplat.prepare.checking.quick_check import wrong_findings
from thermosplat.spectra import CELSIUS, DEFAULT_SPECTRA
from thermosplat.thermal.radiometry import PixelScale

Views = list[View]
Change = Callable[[int, Views], View]


@pytest.fixture(scope="module")
def good() -> Capture:
    return load_capture("sample")


def wrong_notes(capture: Capture) -> list[str]:
    return [one.sentence for one in wrong_findings(capture, DEFAULT_SPECTRA)]


def changed(capture: Capture, spectra: tuple[str, ...], change: Change) -> Capture:
    """The capture with other views, which ``change`` makes of a place and all views in the order of their names."""
    frames = sorted((*capture.train, *capture.test), key=lambda frame: frame.name)
    views = {name: [frame.views[name] for frame in frames] for name in spectra}
    new = {
        frame.name: Frame(frame.name, {**frame.views, **{name: change(place, views[name]) for name in spectra}})
        for place, frame in enumerate(frames)
    }
    train, test = (tuple(new[frame.name] for frame in part) for part in (capture.train, capture.test))
    return replace(capture, train=train, test=test)


def pose(make: Callable[[int, Views], NDArray[np.float64]]) -> Change:
    return lambda place, views: replace(views[place], viewmat=make(place, views))


def image(make: Callable[[int, Views], NDArray[np.generic]]) -> Change:
    return lambda place, views: replace(views[place], image=np.ascontiguousarray(make(place, views)))


def focal(factor: float) -> Change:
    def longer(place: int, views: Views) -> View:
        camera = views[place].camera
        return replace(views[place], camera=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy))

    return longer


def brightened(place: int, views: Views) -> NDArray[np.uint8]:
    return np.clip(views[place].image * (0.5 + place / len(views)), 0, 255).astype(np.uint8)


def with_a_copy(of: int, at: int) -> Change:
    return image(lambda place, views: views[of if place == at else place].image)


BOTH, RGB, THERMAL = ("rgb", "thermal"), ("rgb",), ("thermal",)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def test_good_captures_are_left_alone(good: Capture) -> None:
    """Nothing is said of the sample, in memory or on the disk, nor of points that were made up or have no colours."""
    assert wrong_notes(good) == []
    noise = np.random.default_rng(0)
    made_up = replace(
        good,
        points=noise.uniform(-3, 3, good.points.shape).astype(np.float32),
        point_colors=noise.integers(0, 256, good.point_colors.shape, np.uint8),
        notes=("Without points: starting from 50,000 random points around the cameras.",),
    )
    assert wrong_notes(made_up) == []
    grey = replace(good, point_colors=np.full_like(good.point_colors, 128))
    assert wrong_notes(grey) == []
    on_disk = load_capture("sample", image_memory=1e-4)
    assert on_disk.on_disk is not None
    assert wrong_notes(on_disk) == []


@pytest.mark.rotating
@pytest.mark.parametrize(
    ("spectra", "change", "said"),
    [
        (BOTH, pose(lambda place, views: np.linalg.inv(views[place].viewmat)), "poses are inverted"),
        (BOTH, pose(lambda place, views: FLIP @ views[place].viewmat), "OpenGL's axes"),
        (BOTH, pose(lambda place, views: views[(place + 1) % len(views)].viewmat), r"photograph \+1 places on"),
        (BOTH, pose(lambda place, views: views[(5 * place + 3) % len(views)].viewmat), "of another capture"),
        (BOTH, focal(2.0), "twice as long"),
        (BOTH, focal(0.5), "half as long"),
        (THERMAL, image(lambda place, views: views[place].image[:, ::-1]), "mirrored .* import --mirror"),
        (THERMAL, image(lambda place, views: views[place].image[::-1, ::-1]), "turned by 180° .* import --turn 180"),
        (THERMAL, image(lambda place, views: np.roll(views[place].image, 5, 1)), r"moved by \+2.5% .*\+0.0% down"),
        (THERMAL, image(lambda place, views: np.roll(views[place].image, -5, 0)), r"moved by \+0.0% .*-2.5% down"),
        (THERMAL, image(lambda place, views: views[place - 1].image), "one frame: .* the image after theirs"),
        (RGB, with_a_copy(1, 0), "^1 of 6 held-out RGB images are training images as well .*desk_0000"),
        (RGB, with_a_copy(2, 3), "^1 of 48 RGB images are there twice .*desk_0003.* is .*desk_0002"),
        (THERMAL, with_a_copy(2, 3), "^1 of 48 thermal images are there twice"),
        (RGB, image(lambda place, views: 0 * views[place].image), "^48 of 48 RGB images have one value"),
        (RGB, image(lambda place, views: views[place].image * np.uint8(place != 5)), "^1 of 48 RGB .* one value"),
        (RGB, image(brightened), "exposure of RGB images varies .* --rgb.exposure affine"),
    ],
)
def test_one_thing_that_is_wrong(good: Capture, spectra: tuple[str, ...], change: Change, said: str) -> None:
    """It is said in one sentence, and nothing else is."""
    (note,) = wrong_notes(changed(good, spectra, change))
    with pytest.raises(AssertionError, match=said):
        raise AssertionError(note)


def test_points_of_another_place(good: Capture) -> None:
    """Points that no photograph shows are told, also where they have no colours to compare."""
    grey = np.full_like(good.point_colors, 128)
    (note,) = wrong_notes(replace(good, points=good.points + 1000, point_colors=grey))
    assert "100% of the sparse points lie in no photograph" in note


def turned(degrees: float, seed: int) -> NDArray[np.float64]:
    """[4, 4], a turn about an axis that chance chooses."""
    axis = np.random.default_rng(seed).normal(size=3)
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.radians(degrees) * axis / np.linalg.norm(axis))[0]
    return turn


@pytest.mark.parametrize(
    ("degrees", "said", "settings"),
    [
        (0.02, None, {}),
        (0.5, "Poses of RGB images are inexact: .* --refine poses corrects them", {"refine": ["poses"]}),
        (25.0, "Poses of RGB images are wrong: .* Find them anew", {}),
    ],
)
def test_inexact_poses(good: Capture, degrees: float, said: str | None, settings: dict[str, list[str]]) -> None:
    """Poses that are off by half a degree are corrected while training; without points nothing else can tell."""
    off = changed(good, BOTH, pose(lambda place, views: turned(degrees, place) @ views[place].viewmat))
    found = wrong_findings(replace(off, points=off.points[:0], point_colors=off.point_colors[:0]), DEFAULT_SPECTRA)
    assert [bool(re.search(said or "", one.sentence)) for one in found] == ([True] if said else [])
    assert recommended_by(found) == settings
    assert not any("Poses" in one.sentence for one in wrong_findings(off, DEFAULT_SPECTRA, ["poses"])) or degrees > 1


def measured(good: Capture, celsius: NDArray[np.float32]) -> list[View]:
    view = good.train[0].views["thermal"]
    scaled = ((celsius - celsius.min()) / np.ptp(celsius))[..., None]
    return [replace(view, image=scaled.astype(np.float32), values=celsius)]


@pytest.mark.parametrize(
    ("reading", "said"),
    [
        (lambda celsius: celsius, None),
        (lambda celsius: celsius - 40, None),
        (lambda celsius: 3 * celsius, None),
        (lambda celsius: celsius + 273.15, "As kelvin"),
        (lambda celsius: 10 * celsius, "As tenths of °C"),
        (lambda celsius: 1.8 * celsius + 32, "As °F"),
        (lambda celsius: 10 * (celsius + 273.15) - 273.15, "As tenths of a kelvin"),
        (lambda celsius: (celsius + 273.15) / 10 - 273.15, "As ten times the kelvin"),
        (lambda celsius: celsius + 900, "furnaces"),
    ],
)
def test_temperatures_in_another_unit(good: Capture, reading: Callable, said: str | None) -> None:
    """What no scene has is told with the unit that explains it; cold, warm and hot scenes are not."""
    celsius = np.random.default_rng(0).uniform(12, 32, (48, 64)).astype(np.float32)
    values = reading(celsius).astype(np.float32)
    scale = PixelScale("scalar", range=(float(values.min()), float(values.max())), unit=CELSIUS)
    notes = temperature_notes("thermal", measured(good, values), scale)
    assert len(notes) == (said is not None)
    assert said is None or said in notes[0]


def test_a_palette_in_kelvin(good: Capture) -> None:
    """A palette whose ends are kelvin does not hold the °C that were measured."""
    views = measured(good, np.linspace(12, 32, 48 * 64, dtype=np.float32).reshape(48, 64))
    right, wrong = (PixelScale("color", range=ends, unit=CELSIUS) for ends in ((10.0, 40.0), (283.0, 313.0)))
    assert temperature_notes("thermal", views, right) == []
    (note,) = temperature_notes("thermal", views, wrong)
    assert "palette" in note
    assert "--thermal.range LOW HIGH" in note


def test_check_looks_at_captures_of_other_programs(tmp_path: Path) -> None:
    """A folder with poses is checked without an import, and nothing is written into it."""
    from thermosplat.prepare.capture_folder import CaptureFolder
    from thermosplat.prepare.checking.check import check

    root = load_capture("sample").root
    before = sorted(root.rglob("*"))
    assert check(CaptureFolder(root)).sentences[-1] == "Nothing that was looked at speaks against training."
    assert sorted(root.rglob("*")) == before
