"""Values over time: when dates were, a table, and curves that are straight between dates."""

import re
from datetime import datetime
from pathlib import Path

import pytest

from thermosplat.comparison.curves import over_time_chapter, taken_at
from thermosplat.comparison.over_time import Row

NAMES = ("march", "june", "july")
TIMES = (datetime(2026, 6, 1, 10), datetime(2026, 6, 3, 10), datetime(2026, 6, 11, 10))


def lines(page: str) -> list[list[tuple[float, float]]]:
    """The points [px] of each line of a page's curves."""
    found = re.findall(r'<polyline points="([^"]*)"', page)
    return [[(float(x), float(y)) for x, y in (point.split(",") for point in one.split())] for one in found]


def test_values_lie_at_their_times_and_straight_lines_between() -> None:
    """Two and ten days after the first date; no line goes on beyond the first date or the last."""
    page = over_time_chapter([Row("roof <1>", (10.0, 16.0, 12.0), "°C")], NAMES, TIMES)
    ((first, middle, last),) = lines(page)
    assert (middle[0] - first[0]) / (last[0] - first[0]) == pytest.approx(2 / 10, abs=1e-3)
    assert (last[1] - first[1]) / (middle[1] - first[1]) == pytest.approx(2 / 6, abs=1e-2)
    assert middle[1] < last[1] < first[1]  # downwards [px]
    edges = [float(x) for x in re.findall(r'class="grid" x1="([\d.]+)" y1="44"', page)]
    assert (first[0], last[0]) == pytest.approx((min(edges), max(edges)))
    assert page.count("<circle") == 3
    assert "days since 2026-06-01 10:00" in page
    assert "roof &lt;1&gt; [°C]</td><td>10.00</td><td>16.00</td><td>12.00</td>" in page


def test_dates_in_another_order() -> None:
    """The table keeps the order of the runs, the curve has that of time."""
    row = Row("roof", (12.0, 10.0, 16.0))
    page = over_time_chapter([row], ("july", "march", "june"), (TIMES[2], TIMES[0], TIMES[1]))
    assert lines(page) == lines(over_time_chapter([Row("roof", (10.0, 16.0, 12.0))], NAMES, TIMES))
    assert "<td>12.00</td><td>10.00</td><td>16.00</td>" in page


def test_a_date_without_a_value_breaks_the_line() -> None:
    """What was not seen at a date is not drawn through it."""
    page = over_time_chapter([Row("roof", (10.0, None, 12.0))], NAMES, TIMES)
    assert lines(page) == []
    assert page.count("<circle") == 2
    assert "<td>10.00</td><td>-</td><td>12.00</td>" in page


def test_hours_of_one_day() -> None:
    """A morning and an evening are hours apart."""
    times = (datetime(2026, 6, 1, 6), datetime(2026, 6, 1, 20))
    assert "hours since 2026-06-01 06:00" in over_time_chapter([Row("roof", (1.0, 2.0))], NAMES[:2], times)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ((TIMES[0], None, TIMES[2]), "files of june do not state when"),
        ((TIMES[0], TIMES[0], TIMES[2]), "state the same time"),
    ],
)
def test_dates_without_times_of_their_own(times: tuple[datetime | None, ...], said: str) -> None:
    """A table without curves, and the reason."""
    page = over_time_chapter([Row("roof", (1.0, 2.0, 3.0))], NAMES, times)
    assert said in page
    assert "<td>2.00</td>" in page
    assert "<svg" not in page


def test_nothing_to_tell() -> None:
    """No chapter without places and measurements."""
    assert over_time_chapter([], NAMES, TIMES) == ""


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        (("2026-06-12T10:00:00", "2026-06-12T10:09:00", "2026-06-12T10:03:00"), datetime(2026, 6, 12, 10, 3)),
        (("2026-06-12T10:00:00+02:00", "", ""), datetime(2026, 6, 12, 10)),
        (("yesterday", "", ""), None),
        (("", "", ""), None),
    ],
)
def test_a_date_is_the_middle_of_its_images_times(
    tmp_path: Path, times: tuple[str, ...], expected: datetime | None
) -> None:
    """By the camera's clock; a table without times, or with damaged ones, has no date."""
    rows = "".join(f"thermal,{number}.png,{time}\n" for number, time in enumerate(times))
    (tmp_path / "frames.csv").write_text(f"spectrum,file,time\n{rows}")
    assert taken_at(tmp_path, "thermal") == expected
