"""What the images of a capture say about how it will train, in sentences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.msx import msx_notes
from thermosplat.prepare.checking.point_levels import PointLevels
from thermosplat.prepare.counted import agreeing, counted

Level = Literal["fact", "warning"]
_FEW_FEATURES = 60
"""ORB features of a photograph of 640 px below which it has too little texture: a wall, fog, a blurred image. A
photograph of anything has the full 500."""
_FEATURES = 500
_LONG_SIDE = 640
"""Of the photographs that are looked at [px]."""
_FEW_MATCHES = 12
"""Matches of two photographs, of one motion, below which they do not overlap."""
_NEIGHBOURS = 3
_DEAD_STEPS = 8.0
"""How many times further from its neighbours than pixels are in the median a dead pixel lies, in most images."""
_DEAD_SHARE = 0.1
"""Share of the image's range that it lies from them at least; small objects may lie nearer."""
_VISIBLE_DRIFT = 0.01
"""Share of the scene's own spread below which drift is not worth learning: a level of a palette has 0.4%, and the
spread is a quarter of the palette's span or less. Open choice."""
_SURE = 3.0
"""Standard deviations of a level that its drift must exceed."""
DRIFT_SHARE = 0.25
"""Share of the scene's own spread that the level of images may vary by, before it is called drift."""


@dataclass(frozen=True)
class Finding:
    """One thing that was found.

    Args:
        level: "fact" for information, "warning" for what will go wrong.
        sentence: What was found, and for a warning what to do.
        recommends: Settings of the training that help, as train.yaml has them.
    """

    level: Level
    sentence: str
    recommends: Mapping[str, Any] = field(default_factory=dict)


def recommended_by(findings: Sequence[Finding]) -> dict[str, Any]:
    """Settings of the training that help against findings, as train.yaml has them.

    Args:
        findings: What was found; later ones come on top.
    """
    settings: dict[str, Any] = {}
    for one in findings:
        _lay_over(settings, one.recommends)
    return settings


def _lay_over(settings: dict[str, Any], more: Mapping[str, Any]) -> None:
    for key, value in more.items():
        if isinstance(value, Mapping):
            _lay_over(settings.setdefault(key, {}), value)
        else:
            settings[key] = value


def thermal_findings(
    images: Mapping[str, NDArray[Any]], unit: str | None, levels: PointLevels | None = None
) -> list[Finding]:
    """Ranges, constant images, dead pixels and drift of thermal images.

    Args:
        images: [H, W] values by name, in °C where ``unit`` is "°C".
        unit: What to write after the values; None for pictures in colour, of which nothing is said.
        levels: The images' levels as points say; None: they are judged by the images' medians.
    """
    if unit is None or not images:
        return []
    found = []
    lows, highs = zip(*(np.percentile(image, [0.1, 99.9]) for image in images.values()), strict=True)
    constant = [name for name, low, high in zip(images, lows, highs) if high <= low]
    low, high = min(lows), max(highs)
    digits = 1 if unit == "°C" else 0
    found.append(Finding("fact", f"Thermal values lie between {low:,.{digits}f} and {high:,.{digits}f} {unit}."))
    if unit == "°C" and not (low > -60 and high < 1500):
        found.append(Finding("warning", "Such temperatures are unusual. Is the unit right? See import --unit."))
    if constant:
        found.append(
            Finding(
                "warning",
                f"{len(constant)} of {counted(len(images), 'thermal image')} "
                f"{agreeing(len(constant), 'has', 'have')} one value everywhere (first: {constant[0]}): "
                "the shutter was closed, or the file is damaged. Remove them.",
            )
        )
    dead = count_dead_pixels(list(images.values()))
    if dead:
        found.append(
            Finding(
                "warning",
                f"{counted(dead, 'thermal pixel differs', 'thermal pixels differ')} from "
                f"{agreeing(dead, 'its', 'their')} neighbours in most images: "
                f"{agreeing(dead, 'it is', 'they are')} dead.",
            )
        )
    alive = [image for name, image in images.items() if name not in constant]
    drift, spread = level_drift(alive) if alive else (0.0, 0.0)
    if levels is not None:
        found += _drift_of_points(levels, spread, unit)
    elif drift > DRIFT_SHARE * spread and len(alive) >= 5:
        found.append(
            Finding(
                "warning",
                f"The level of thermal images varies by {drift:,.{digits + 1}f} {unit} (standard deviation), the scene "
                f"by {spread:,.{digits + 1}f}. If the scene is the same in all, the sensor drifts: train with "
                "--thermal.exposure level, as train.yaml recommends.",
                {"spectra": {"thermal": {"exposure": "level"}}},
            )
        )
    return found


def _drift_of_points(levels: PointLevels, spread: float, unit: str) -> list[Finding]:
    """Of a drift that is larger than chance and than what nobody sees."""
    if levels.drift <= max(_SURE * levels.deviation, _VISIBLE_DRIFT * spread):
        return []
    digits = 2 if unit == "°C" else 0
    return [
        Finding(
            "fact",
            f"The level of thermal images drifts by {levels.drift:,.{digits}f} {unit} (standard deviation; "
            f"{counted(levels.points, 'point')} that several images see tell it). Training learns the level of each "
            "image, as train.yaml recommends, and holds their mean.",
            {"spectra": {"thermal": {"exposure": "level"}}},
        )
    ]


def count_dead_pixels(images: Sequence[NDArray[Any]]) -> int:
    """Pixels that lie far from their neighbours in at least nine of ten images; 0 for images of several sizes."""
    if len(images) < 3 or len({image.shape for image in images}) > 1:
        return 0
    votes = np.zeros(images[0].shape, np.int64)
    for image in images:
        values = image.astype(np.float32)
        distance = np.abs(values - cv2.medianBlur(values, 3))
        low, high = np.percentile(values, [0.5, 99.5])
        votes += distance > max(_DEAD_STEPS * float(np.median(distance)), _DEAD_SHARE * float(high - low), 1e-6)
    return int((votes >= 0.9 * len(images)).sum())


def level_drift(images: Sequence[NDArray[Any]]) -> tuple[float, float]:
    """Standard deviation of the images' medians, and the median of the standard deviations inside images."""
    medians = [float(np.median(image[::4, ::4])) for image in images]
    spreads = [float(image[::4, ::4].std()) for image in images]
    return float(np.std(medians)), float(np.median(spreads))


def texture_findings(photographs: Mapping[str, NDArray[np.uint8]]) -> list[Finding]:
    """Photographs without texture, and photographs that overlap with none of their neighbours.

    Args:
        photographs: [H, W, 3] by name, in the order in which they were taken.
    """
    orb = cv2.ORB.create(_FEATURES)
    described = {name: _features(image, orb) for name, image in photographs.items()}
    plain = [name for name, (points, _) in described.items() if len(points) < _FEW_FEATURES]
    found = []
    if plain:
        found.append(
            Finding(
                "warning",
                f"{len(plain)} of {counted(len(described), 'photograph')} {agreeing(len(plain), 'has', 'have')} "
                f"hardly any texture (first: {plain[0]}): blurred, "
                "dark or of a plain surface. Poses cannot be found from them; take others.",
            )
        )
    rich = [(name, features) for name, features in described.items() if name not in plain]
    lonely = [
        name
        for place, (name, features) in enumerate(rich)
        if not any(
            _matches(features, other) >= _FEW_MATCHES
            for near, (_, other) in enumerate(rich)
            if 0 < abs(near - place) <= _NEIGHBOURS
        )
    ]
    if len(rich) > 1 and lonely:
        found.append(
            Finding(
                "warning",
                f"{len(lonely)} of {len(rich)} photographs {agreeing(len(lonely), 'shows', 'show')} nothing of "
                f"their neighbours' (first: {lonely[0]}): "
                "take them closer together, so that two of three parts of an image are on the next one.",
            )
        )
    return found


def _features(image: NDArray[np.uint8], orb: Any) -> tuple[Any, Any]:
    factor = min(1.0, _LONG_SIDE / max(image.shape[:2]))
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY) if small.ndim == 3 else small
    points, descriptors = orb.detectAndCompute(grey, None)
    return [point.pt for point in points], descriptors


def _matches(one: tuple[Any, Any], two: tuple[Any, Any]) -> int:
    """Number of matching features that one epipolar geometry explains."""
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(one[1], two[1])
    if len(matches) < 8:
        return 0
    first = np.array([one[0][match.queryIdx] for match in matches], np.float32)
    second = np.array([two[0][match.trainIdx] for match in matches], np.float32)
    cv2.setRNGSeed(0)
    _, inside = cv2.findHomography(first, second, cv2.RANSAC, 8.0)
    return 0 if inside is None else int(inside.sum())


def msx_findings(pairs: Sequence[tuple[NDArray[np.uint8], NDArray[np.uint8]]]) -> list[Finding]:
    """Visible edges in thermal pictures; photographs are brought to their size.

    Args:
        pairs: Photographs and thermal pictures, both [H, W, 3].
    """
    alike = [
        (cv2.resize(photograph, thermal.shape[1::-1], interpolation=cv2.INTER_AREA), thermal)
        for photograph, thermal in pairs
    ]
    return [Finding("warning", note) for note in msx_notes(alike)]
