"""Findings: parts of a scene that are warmer, or colder, than a reference.

The reference of a pixel is the median of its surroundings in the same picture, or the mean of a measured area. What
lies beyond it by more than a limit becomes regions of the scene (``thermography.hot_regions``). The numbers of a
finding are those of the view that sees the most of it. Where most of its pixels must not be read there, as glass and
chrome, it is none.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.thermography.certainty import DOUBTS, SMALL, Sure
from thermosplat.thermography.extents import area_of
from thermosplat.thermography.hot_regions import Region, find_regions
from thermosplat.viewer.layers import Layer
from thermosplat.viewer.measuring import Measurer, SearchedView, grid_cell

Array = NDArray[np.float64]
MOST_FINDINGS = 60
"""Of a report, the farthest from the reference first."""
_SURROUNDINGS = 1 / 3
"""Side of a pixel's surroundings, as a share of the picture's shorter side: a finding fills less than half of it."""
_LEVELS = 255
"""That the values are sorted into for their median, which OpenCV finds in large windows of 8 bits alone."""
_TIMES_USUAL = 4.0
"""Times the usual spread around the reference (1.4826 times the median of the distances): the limit by default."""
LEAST_DEGREES = 1.0
"""[K]; the least limit that is chosen where nobody gives one."""
_MOST_DOUBTED = 0.5
"""Share of a finding's pixels that must not be read, from which on it is none."""


@dataclass(frozen=True, eq=False)
class Finding:
    """A part of the scene that is far from the reference, and its numbers in the view that sees the most of it."""

    region: Region
    """Place and extent in the world."""
    seen: SearchedView
    """The view."""
    pixels: NDArray[np.bool_]
    """Its pixels there, [H, W]."""
    minimum: float
    maximum: float
    mean: float
    reference: float
    """Median of the pixels' references."""
    uncertainty: float | None
    """Half of the 95% interval of the mean; None: nobody knows."""
    area: float | None
    """Its surface [world units²]; None: too few pixels."""
    doubts: tuple[int, ...]
    """Why some of its pixels should not be read, bits of ``DOUBTS``."""

    @property
    def difference(self) -> float:
        """Mean minus reference."""
        return self.mean - self.reference


@dataclass(frozen=True, eq=False)
class Found:
    """What a search has found."""

    findings: tuple[Finding, ...]
    """The farthest from the reference first."""
    limit: float
    """Least distance from the reference."""
    not_read: int
    """Regions that were left out, as they must not be read."""
    more: int
    """Regions beyond the most that a report lists."""


def find(
    measurer: Measurer,
    spectrum: str,
    *,
    limit: float | None = None,
    reference: float | None = None,
    colder: bool = False,
    least: float = 0.0,
) -> Found:
    """Look for findings in all views of the capture.

    Args:
        measurer: Of the scene.
        spectrum: Where.
        limit: Least distance from the reference, > 0; None: four times the usual one.
        reference: The same for the whole scene; None: of each pixel the median of its surroundings.
        colder: They are below the reference.
        least: The least limit that is chosen where ``limit`` is None.

    Raises:
        UserError: There are no photographs to search by.
    """
    views = list(measurer.searched(spectrum))
    references = [surroundings(view) if reference is None else np.full_like(view.values, reference) for view in views]
    sign = -1.0 if colder else 1.0
    beyond = [sign * (view.values - around) for view, around in zip(views, references)]
    if limit is None:
        apart = np.concatenate([np.abs(far[view.there]) for view, far in zip(views, beyond)] or [np.zeros(0)])
        usual = float(np.median(apart)) if len(apart) else 0.0
        limit = max(_TIMES_USUAL * 1.4826 * usual, least, 1e-6)
    masks = [view.there & (far > limit) for view, far in zip(views, beyond)]
    hot = [view.hot(mask) for view, mask in zip(views, masks)]
    cell = grid_cell([view.distance for view in views])
    regions = find_regions(hot, cell, colder=colder)
    findings, not_read = [], 0
    known: dict[int, Sure | None] = {}
    for region in regions:
        best = region.best_view
        pixels = masks[best] & _inside(views[best].points, region, cell)
        if best not in known:  # it takes a while, and many regions share a view
            known[best] = measurer.renderer.how_sure(Layer("image", spectrum), views[best].view)
        sure = known[best]
        if not pixels.any() or must_not_be_read(sure, pixels):
            not_read += 1
            continue
        findings.append(_finding(region, views[best], pixels, references[best], sure))
    findings.sort(key=lambda one: sign * one.difference, reverse=True)
    return Found(tuple(findings[:MOST_FINDINGS]), limit, not_read, max(0, len(findings) - MOST_FINDINGS))


def surroundings(seen: SearchedView) -> Array:
    """The median of each pixel's surroundings, [H, W].

    Args:
        seen: The view.
    """
    values, there = seen.values, seen.there
    if not there.any():
        return np.zeros_like(values)
    low, high = np.percentile(values[there], (0.5, 99.5))
    step = max(float(high - low), 1e-9) / _LEVELS
    filled = np.where(there, values, np.median(values[there]))
    levels = np.rint(np.clip((filled - low) / step, 0, _LEVELS)).astype(np.uint8)
    window = 2 * max(1, round(_SURROUNDINGS * min(values.shape) / 2)) + 1
    median: Array = low + step * cv2.medianBlur(levels, window).astype(np.float64)
    return median


def must_not_be_read(sure: Sure | None, pixels: NDArray[np.bool_]) -> bool:
    """Whether most pixels should not be read. That they are few is no reason: a hot screw is a finding.

    Args:
        sure: How sure the view is; None: nobody knows.
        pixels: Which ones, [H, W].
    """
    return sure is not None and float(((sure.doubts & ~np.uint8(SMALL))[pixels] > 0).mean()) > _MOST_DOUBTED


def normalised(difference: float, irradiance: float) -> float:
    """A temperature difference [K] of a photovoltaic module as it would be at 1000 W/m² (IEC TS 62446-3).

    Args:
        difference: As measured [K].
        irradiance: On the modules' plane while it was measured [W/m²], > 0.
    """
    return difference * 1000.0 / irradiance


def _inside(points: Array, region: Region, cell: float) -> NDArray[np.bool_]:
    """Where points [H, W, 3] lie in the box around a region."""
    apart = np.abs(points - np.array(region.place))
    inside: NDArray[np.bool_] = (apart <= np.array(region.size) + cell).all(axis=-1)
    return inside


def _finding(
    region: Region, seen: SearchedView, pixels: NDArray[np.bool_], references: Array, sure: Sure | None
) -> Finding:
    values = seen.values[pixels]
    depth = np.where(seen.depth > 0, seen.depth, np.nan)
    rows, columns = np.nonzero(pixels)
    return Finding(
        region=region,
        seen=seen,
        pixels=pixels,
        minimum=float(values.min()),
        maximum=float(values.max()),
        mean=float(values.mean()),
        reference=float(np.median(references[pixels])),
        uncertainty=_root_mean_square(sure.half_width[pixels]) if sure is not None else None,
        area=area_of((rows, columns), depth, seen.view.K.double().cpu().numpy()),
        doubts=() if sure is None else _bits(sure.doubts[pixels]),
    )


def _bits(doubts: NDArray[np.uint8]) -> tuple[int, ...]:
    return tuple(bit for bit in DOUBTS if (doubts & bit).any())


def _root_mean_square(halves: Array) -> float | None:
    known = halves[np.isfinite(halves)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else None
