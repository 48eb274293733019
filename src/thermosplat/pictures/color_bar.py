"""The legend of a picture of values: its palette from the lowest to the highest value, with ticks in their unit."""

import math
from itertools import pairwise

import cv2
import numpy as np

from thermosplat.pictures.image_display import Image8, rgb_bytes
from thermosplat.thermal.radiometry import Palette

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
"""Distances between ticks that people count in, times a power of ten."""


def tick_values(low: float, high: float, most: int = 6) -> list[float]:
    """Round values to mark between two values.

    Args:
        high: The highest value; ticks go the other way where it is less.
        most: How many ticks there may be, >= 2.

    Returns:
        At most ``most`` multiples of 1, 2, 2.5 or 5 times a power of ten, rising; ``[low]`` of an empty range.
    """
    first, last = min(low, high), max(low, high)
    if not math.isfinite(first) or not math.isfinite(last) or last - first <= 1e-12 * max(abs(first), abs(last), 1e-30):
        return [low]
    rough = (last - first) / most
    power = 10.0 ** math.floor(math.log10(rough))
    for step in (power * factor for factor in _STEPS):
        lowest, highest = math.ceil(first / step - 1e-9), math.floor(last / step + 1e-9)
        if highest - lowest + 1 <= most:
            break
    return [number * step for number in range(lowest, highest + 1)]


def tick_labels(values: list[float]) -> list[str]:
    """Numbers with as many digits as tell them apart."""
    step = min((abs(b - a) for a, b in pairwise(values)), default=abs(values[0]) or 1.0)
    digits = max(0, -math.floor(math.log10(step))) if step > 0 else 0
    if round(step, digits) != float(f"{step:.12g}"):  # a step of 2.5
        digits += 1
    return [f"{value:.{digits}f}" for value in values]


def color_bar(palette: Palette, low: float, high: float, unit: str, height: int) -> Image8:
    """A colour bar on black, to stand beside a picture.

    Args:
        unit: Written above it, such as "°C"; "" for values without one.
        height: Height of the picture [px], at least 60.

    Returns:
        8-bit RGB, shape [height, width, 3].
    """
    size = max(0.35, height / 1100)
    stroke = max(1, round(height / 700))
    line = round(26 * size) + 4
    values = [value for value in tick_values(low, high, max(2, min(8, height // (3 * line))))]
    labels = tick_labels(values)
    text_width = max(cv2.getTextSize(text, _FONT, size, stroke)[0][0] for text in (*labels, unit.replace("°", "o")))
    bar_left, bar_width = round(10 * size) + 4, round(28 * size) + 6
    tick = max(3, round(10 * size))
    width = bar_left + bar_width + 2 * tick + text_width + round(14 * size)
    picture = np.zeros((height, width, 3), np.uint8)
    top, bottom = 2 * line, height - line
    shares = np.linspace(1.0, 0.0, bottom - top)[:, None].repeat(bar_width, axis=1)
    picture[top:bottom, bar_left : bar_left + bar_width] = rgb_bytes(palette.to_color(shares))
    cv2.rectangle(picture, (bar_left - 1, top - 1), (bar_left + bar_width, bottom), (160, 160, 160), 1)
    span = high - low
    for value, text in zip(values, labels):
        y = round(bottom - 1 - (value - low) / span * (bottom - top - 1)) if span else bottom - 1
        right = bar_left + bar_width
        cv2.line(picture, (right, y), (right + tick, y), (220, 220, 220), stroke)
        cv2.putText(picture, text, (right + 2 * tick, y + line // 3), _FONT, size, (255, 255, 255), stroke, cv2.LINE_AA)
    write_text(picture, unit, bar_left, line + line // 4, size, stroke)
    return picture


def write_text(picture: Image8, text: str, x: int, y: int, size: float, stroke: int) -> int:
    """Write white text into a picture; OpenCV's fonts have no degree sign, so a small ring is drawn for it.

    Args:
        picture: 8-bit RGB, changed in place.
        text: ASCII and "°".
        x: Where it begins [px].
        y: Its base line [px].
        size: Size of OpenCV's font.
        stroke: Width of its lines [px].

    Returns:
        Where it ends [px].
    """
    color = (255, 255, 255)
    for index, part in enumerate(text.split("°")):
        if index:
            radius = max(2, round(4 * size))
            cv2.circle(picture, (x + radius, round(y - 20 * size + radius / 2)), radius, color, stroke, cv2.LINE_AA)
            x += 3 * radius
        cv2.putText(picture, part, (x, y), _FONT, size, color, stroke, cv2.LINE_AA)
        x += cv2.getTextSize(part, _FONT, size, stroke)[0][0]
    return x
