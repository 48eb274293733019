"""Floors and summaries of the rasterization benchmark are the arithmetic they claim to be."""

from typing import Any

import pytest

from measuring.device_peaks import DevicePeaks
from measuring.floors import BACKWARD_OPERATIONS, BACKWARD_PER_CHANNEL, FORWARD_OPERATIONS, stage_floors
from measuring.fragments import Fragments
from peers.renderers import GRAPH, OURS
from rasterization.summary import summaries, summary, summary_lines


def row(scene: str, case: str, ours_ms: float, gsplat_ms: float, memory: float = 0.4) -> dict[str, Any]:
    """A row with the same ratio forward and backward."""
    times = {"thermosplat": {"median_ms": ours_ms}, "gsplat": {"median_ms": gsplat_ms}}
    return {
        "scene": scene,
        "size": "640x480",
        "case": case,
        "forward": times,
        "forward_backward": times,
        "peak_memory_mib": {"thermosplat": 100 * memory, "gsplat": 100.0},
        "apart": {},
    }


def test_geometric_mean_and_worst_case_against_the_targets() -> None:
    """2x and 8x make 4x; the mean reaches D = 11's target, one case below 2x does not."""
    rows = [row("garden x1", "features11", 1.0, 1.9), row("garden x25", "features11", 1.0, 8.0, memory=0.9)]
    by_label = {entry["label"]: entry for entry in summary(rows, "gsplat")["targets"]}
    found = by_label["D = 11"]
    assert found["mean"] == pytest.approx((1.9 * 8.0) ** 0.5)
    assert found["worst"] == pytest.approx(1.9)
    assert found["worst_case"].startswith("garden x1 ")
    assert not found["reached"]
    memory = by_label["peak memory"]
    assert (memory["worst"], memory["mean"]) == (pytest.approx(0.9), pytest.approx(0.6))
    assert not memory["reached"]
    with_results = summary([one | {"results_mib": 30.0} for one in rows], "gsplat")["targets"]
    assert {e["measure"]: e["mean"] for e in with_results}["results"] == pytest.approx(0.3)
    assert {entry["label"] for entry in summary(rows[1:], "gsplat")["targets"] if entry["reached"]} >= {"D = 11"}


def test_rows_in_which_a_peer_disagrees_do_not_count() -> None:
    """A peer that draws something else is not compared."""
    apart = row("a", "rgb", 1.0, 100.0) | {"apart": {"gsplat": "images differ"}}
    (found,) = summaries([apart, row("b", "rgb", 1.0, 3.0)])
    for entry in found["targets"]:
        assert entry["cases"] == 1
        assert entry["mean"] == pytest.approx(0.4 if entry["measure"] == "memory" else 3.0)


def test_each_of_our_renderers_is_summarised() -> None:
    """Eager and in a graph, each against every peer, not against one another; where a graph is apart does not count."""
    rows = [row("garden x1", "rgb", 2.0, 4.0), row("garden x5", "rgb", 2.0, 4.0)]
    for one in rows:  # the same dictionary as forward_backward
        one["forward"][GRAPH] = {"median_ms": 1.0}
    rows[1]["apart"] = {GRAPH: "images differ"}
    eager, graph = summaries(rows)
    assert [(found["ours"], found["peer"]) for found in (eager, graph)] == [(OURS, "gsplat"), (GRAPH, "gsplat")]
    both = [{e["measure"]: (e["cases"], e["mean"]) for e in found["targets"]} for found in (eager, graph)]
    assert both[0]["forward_backward"] == (2, pytest.approx(2.0))
    assert both[1]["forward_backward"] == (1, pytest.approx(4.0))
    assert "memory" not in both[1]
    assert "thermosplat in a graph against gsplat" in "\n".join(summary_lines(graph))


def test_the_summary_says_who_is_ahead() -> None:
    """Faster-GS is 1.71 and 2.20 times gsplat on garden x1 at 640x480."""
    lines = "\n".join(summary_lines(summary([row("garden x1", "rgb", 1.0, 2.3)], "gsplat")))
    assert "| garden x1 640x480 | 2.30 | 1.71 | 2.30 | 2.20 | ahead |" in lines
    lines = "\n".join(summary_lines(summary([row("garden x1", "rgb", 1.0, 2.0)], "gsplat")))
    assert "**behind**" in lines


def test_floors_follow_bytes_and_operations() -> None:
    """The blending is bound by whichever peak is lower, and each stage by what it must move."""
    fragments = Fragments(listed=10**9, drawn=10**8, thermal=0, either=10**8, visible=1000, longest=50)
    arguments = (fragments, 1000, 5000, (640, 480), 1200, (3, 0))
    floors = stage_floors(*arguments, DevicePeaks(1e12, 2e9, 2e9, 2e9))
    assert floors["blending"]["operations"] == 10**8 * (FORWARD_OPERATIONS + 3)
    assert floors["blending"]["floor_ms"] == pytest.approx(1e3 * 10**8 * (FORWARD_OPERATIONS + 3) / 1e9)
    expected = 1e3 * 10**8 * (BACKWARD_OPERATIONS + 3 * BACKWARD_PER_CHANNEL) / 1e9
    assert floors["blending adjoint"]["floor_ms"] == pytest.approx(expected)
    assert floors["blending"]["bound"] == "operations"
    slow_memory = stage_floors(*arguments, DevicePeaks(1e6, 2e30, 2e30, 2e30))
    # 640x480 pixels of 3 colours, a transmittance and a last pair; 1,000 Gaussians' records; 5,000 pairs
    assert slow_memory["blending"]["bytes"] == 640 * 480 * 20 + 1000 * (8 + 12 + 4 + 12) + 4 * 5000
    assert slow_memory["blending"]["floor_ms"] == pytest.approx(1e-3 * slow_memory["blending"]["bytes"])
    assert slow_memory["projection"]["operations"] == 0
