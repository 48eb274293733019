"""Findings: parts of a scene that are warmer, or colder, than a reference.

The reference of a pixel is the median of its like around it (``reporting.likes``), or the mean of a measured area. What
lies beyond it by more than a limit in most views becomes regions of the scene (``thermography.hot_regions``), the
hottest first. In the view that sees the most of it a region grows to where half of its difference is left: there it
ends. It is no finding where little of that is beyond its own like: a road is, beside the lawn, and the road as a whole
is not. Where most of its pixels must not be read, as glass and chrome, it is none either. What has nothing like it
around it, as a car and a chimney have nothing, is compared with whatever surrounds it, and listed as a thing.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermosplat.reporting.likes import Elements, photographs_of
from thermosplat.reporting.patterns import patterns
from thermosplat.reporting.warm_parts import FEWEST_PIXELS, compact_parts, grown, surroundings
from thermosplat.thermography.certainty import DOUBTS, SMALL, Sure
from thermosplat.thermography.extents import area_of
from thermosplat.thermography.hot_regions import Region, find_regions
from thermosplat.viewer.layers import Layer
from thermosplat.viewer.measuring import Measurer, SearchedView, grid_cell

Array = NDArray[np.float64]
MOST_FINDINGS = 60
"""Of a report, the farthest from the reference first."""
MOST_THINGS = 12
"""Half of a page: a client reads no more of what is no finding. Open choice."""
_LEVELS = (8.0, 4.0, 2.0, 1.0)
"""Times the limit that is looked beyond, one after the other: noise beyond the limit alone connects a hot cell with the
next module."""
_TIMES_USUAL = 4.0
"""Times the usual spread around the reference (1.4826 times the median of the distances): the limit by default."""
LEAST_DEGREES = 0.8
"""[K]; the least limit that is chosen where nobody gives one."""
_WIDTH = 400
"""Of the pictures that are searched [px]: in half a flight's thermal image a cell of a module has some pixels."""
_MANY_VIEWS = 96
"""From so many on every second one is searched: of a flight's 101 they find as much, and less that is false."""
_FEWEST_VIEWS, _LEAST_VIEWS = {1: 5, 2: 4}, 0.5
"""Of a finding: views that agree, by each which view is searched, and their share of those that see the place."""
_NEIGHBOURS, _ONE_SURFACE = 10, 0.5
"""Cells that lie between parts of one pattern, and the difference of their references, as a share of the limit."""
_MOST_OF = 0.5
"""Share of a region that a region in it takes, from which on both are one."""
_STEP = 0.55
"""Of the cells that connect pixels to regions, as a share of the grid's: little more than a pixel."""
_OF_PEAK, _ENOUGH_PIXELS = 1 / (2 * np.log(2)), 36
"""Least difference of a region, as a share of the limit: what lies beyond half of a Gaussian's peak has this share of
it in the mean. With fewer pixels, 6x6 by choice, a region differs by more, in proportion to the root of their number:
at edges of surfaces some pixels are always off."""
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
    def surface(self) -> float:
        """The area, or what all views together say of it where the pixels are too few [world units²]."""
        return self.region.area if self.area is None else self.area

    @property
    def difference(self) -> float:
        """Mean minus reference."""
        return self.mean - self.reference


@dataclass(frozen=True, eq=False)
class Found:
    """What a search has found."""

    findings: tuple[Finding, ...]
    """The farthest from the reference first."""
    things: tuple[Finding, ...]
    """The same of what has nothing like it around, at most ``MOST_THINGS``."""
    limit: float
    """Least distance from the reference."""
    not_read: int
    """Regions that would be listed and were left out, as they must not be read."""
    more: int
    """Regions beyond the most that a report lists."""
    more_things: int = 0
    """Things beyond those that are listed; of these nobody asks whether they may be read."""
    views: tuple[SearchedView, ...] = ()
    """In which they were looked for."""


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
    every = 2 if sum(spectrum in frame.views for frame in measurer.scene.frames) >= _MANY_VIEWS else 1
    views = list(measurer.searched(spectrum, _WIDTH, every))
    elements = Elements(views, None if reference is not None else photographs_of(measurer, views))
    references = elements.references() if reference is None else [np.full(one.values.shape, reference) for one in views]
    sign = -1.0 if colder else 1.0
    if limit is None:
        apart = np.concatenate([np.abs(view.values - around)[view.there] for view, around in zip(views, references)])
        apart = apart[np.isfinite(apart)]
        usual = float(np.median(apart)) if len(apart) else 0.0
        limit = max(_TIMES_USUAL * 1.4826 * usual, least, 1e-6)

    def beyond(of_each: list[Array], times: float = 1.0) -> list[NDArray[np.bool_]]:
        far = [sign * (view.values - around) for view, around in zip(views, of_each)]
        return [view.there & (np.nan_to_num(one, nan=-np.inf) > times * limit) for view, one in zip(views, far)]

    search = _Search(measurer, spectrum, views, sign, limit, _FEWEST_VIEWS[every])
    if reference is None:
        others = [np.where(np.isfinite(one), np.nan, surroundings(view)) for view, one in zip(views, references)]
        for times in _LEVELS:
            masks = beyond(references, times)
            regions = [grown(view, mask, around, sign) for view, mask, around in zip(views, masks, references)]
            search.add(elements.agreed(regions), references)
            search.add_things(elements.agreed(beyond(others, times)), others)
    else:
        search.add(elements.agreed(beyond(references)), references)
    found, things = search.found(), search.things()
    more, listed = max(0, len(found) - MOST_FINDINGS), search.readable(things)
    more_things = max(0, len(things) - MOST_THINGS)
    return Found(tuple(found[:MOST_FINDINGS]), listed, limit, search.not_read, more, more_things, tuple(views))


class _Search:
    """Regions become findings or things, the first ones before those that hold them.

    Args:
        measurer: Of the scene.
        spectrum: Where.
        views: Of the capture.
        sign: -1 where they are below the reference, else 1.
        limit: Least distance from the reference.
        fewest: Views that agree on a region.
    """

    def __init__(
        self, measurer: Measurer, spectrum: str, views: list[SearchedView], sign: float, limit: float, fewest: int
    ) -> None:
        self._measurer, self._spectrum, self._views = measurer, spectrum, views
        self._sign, self._limit, self._fewest = sign, limit, fewest
        places = [view.points[::2, ::2][view.there[::2, ::2]] for view in views]
        of_view = np.repeat(np.arange(len(views)), [len(some) for some in places])
        everywhere = np.concatenate(places)
        order = np.argsort(everywhere[:, 0])
        self._places, self._of_view = everywhere[order], of_view[order]
        self._known: dict[SearchedView, tuple[NDArray[np.bool_], Sure | None]] = {}
        self._cell = grid_cell(views)
        self._findings: list[Finding] = []
        self._things: list[Finding] = []
        self._doubted: list[Region] = []

    def add(self, masks: list[NDArray[np.bool_]], references: list[Array]) -> None:
        """Regions that may be read become findings.

        Args:
            masks: Pixels of regions, of each view.
            references: From what; NaN where nobody knows.
        """
        fresh = list[Finding]()
        for region, pixels in self._fresh(masks, references, self._findings):
            view, around = self._views[region.best_view], references[region.best_view]
            sure = self._sure(view, pixels)
            if must_not_be_read(sure, pixels):
                self._doubted.append(region)
                continue
            parts = [_finding(one, view, part, around, sure) for one, part in compact_parts(region, view, pixels)]
            fresh += [one for one in parts if self.far(one) > _OF_PEAK * self._limit]
        self._findings += fresh

    def add_things(self, masks: list[NDArray[np.bool_]], references: list[Array]) -> None:
        """Regions become things, before anybody asks whether they may be read; arguments as of ``add``."""
        fresh = list[Finding]()
        for region, pixels in self._fresh(masks, references, self._things):
            view, around = self._views[region.best_view], references[region.best_view]
            fresh += [_finding(one, view, part, around, None) for one, part in compact_parts(region, view, pixels)]
        self._things += fresh

    @property
    def not_read(self) -> int:
        """Regions that were left out, as they must not be read."""
        return len(self._doubted)

    def found(self) -> list[Finding]:
        """What was added, the farthest from the reference first."""
        found = [one for one in self._patterns(self._findings) if self._stands_out(one)]
        return sorted(found, key=self.far, reverse=True)

    def things(self) -> list[Finding]:
        """What was added as a thing, the farthest from the reference first."""
        return sorted(self._patterns(self._things), key=self.far, reverse=True)

    def readable(self, things: list[Finding]) -> tuple[Finding, ...]:
        """The first things that may be read, at most ``MOST_THINGS``."""
        listed = list[Finding]()
        for one in things:
            if len(listed) == MOST_THINGS:
                break
            if must_not_be_read(self._sure(one.seen, one.pixels), one.pixels):
                self._doubted.append(one.region)
            else:
                listed.append(one)
        return tuple(listed)

    def _patterns(self, findings: list[Finding]) -> list[Finding]:
        return patterns(findings, _NEIGHBOURS * self._cell, _ONE_SURFACE * self._limit)

    def _stands_out(self, one: Finding) -> bool:
        """Whether it is far enough from its reference for so few pixels."""
        return self.far(one) > self._limit * float(np.sqrt(_ENOUGH_PIXELS / one.pixels.sum()))

    def far(self, one: Finding) -> float:
        """How far a finding is from its reference."""
        return self._sign * one.difference

    def _regions(
        self, masks: list[NDArray[np.bool_]], references: list[Array]
    ) -> Iterator[tuple[Region, NDArray[np.bool_]]]:
        """Regions that are large enough, and their pixels in the view that sees the most of them, [H, W]."""
        hot = [view.hot(mask) for view, mask in zip(self._views, masks)]
        for region in find_regions(hot, _STEP * self._cell, colder=self._sign < 0):
            if region.pixels < FEWEST_PIXELS or region.views < self._fewest:
                continue
            best = region.best_view
            pixels = masks[best] & _inside(self._views[best].points, region, self._cell)
            if np.isfinite(references[best][pixels]).any():
                yield region, pixels

    def _fresh(
        self, masks: list[NDArray[np.bool_]], references: list[Array], among: list[Finding]
    ) -> Iterator[tuple[Region, NDArray[np.bool_]]]:
        """Regions that enough views agree on and that are most of none of some findings; as of ``_regions``."""
        known = [*self._doubted, *(one.region for one in among)]
        for region, pixels in self._regions(masks, references):
            inside = [one for one in known if (np.abs(np.subtract(one.place, region.place)) <= region.size).all()]
            if not any(one.area >= _MOST_OF * region.area for one in inside) and self._is_agreed(region):
                yield region, pixels

    def _is_agreed(self, region: Region) -> bool:
        """Whether enough of the views that see a place agree."""
        return region.views >= _LEAST_VIEWS * self._seeing(region)

    def _seeing(self, region: Region) -> int:
        """Views that see a place."""
        half = np.array(region.size) / 2
        x, middle = self._places[:, 0], region.place[0]
        near = slice(np.searchsorted(x, middle - half[0], "left"), np.searchsorted(x, middle + half[0], "right"))
        inside = (np.abs(self._places[near, 1:] - region.place[1:]) <= half[1:]).all(axis=-1)
        return len(np.unique(self._of_view[near][inside]))

    def _sure(self, view: SearchedView, pixels: NDArray[np.bool_]) -> Sure | None:
        """How sure a view is in some pixels at least, [H, W]."""
        asked, sure = self._known.get(view, (np.zeros_like(pixels), None))
        if (pixels & ~asked).any():  # it takes a while, and many regions share a view
            asked = asked | pixels
            taken = view.values if view.is_as_taken else None
            sure = self._measurer.renderer.how_sure(Layer("image", self._spectrum), view.view, asked, taken)
            self._known[view] = asked, sure
        return sure


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
        reference=float(np.nanmedian(references[pixels])),
        uncertainty=_root_mean_square(sure.half_width[pixels]) if sure is not None else None,
        area=area_of((rows, columns), depth, seen.view.K.double().cpu().numpy()),
        doubts=() if sure is None else tuple(bit for bit in DOUBTS if (sure.doubts[pixels] & bit).any()),
    )


def _root_mean_square(halves: Array) -> float | None:
    known = halves[np.isfinite(halves)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else None
