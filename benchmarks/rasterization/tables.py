"""The report of bench_rasterization.py as Markdown, for benchmarks/records/."""

from collections.abc import Iterator
from typing import Any

from measuring.agreement import largest
from peers.renderers import ALL_OURS, OURS
from rasterization.summary import Row, comparison, summary_lines


def markdown(report: dict[str, Any]) -> str:
    """All tables of a report.

    Args:
        report: as written to the JSON file.
    """
    environment = report["environment"]
    lines = [
        f"{environment['date']}, {environment['device']}, torch {environment['torch']}, Warp {environment['warp']}; "
        + "; ".join(environment["renderers"].values())
        + f". `{environment['command']}`",
    ]
    if peaks := report.get("peaks"):
        lines.append(
            f"Measured peaks: {peaks['bytes_per_s'] / 1e9:,.0f} GB/s, "
            f"{peaks['flops_fp32'] / 2e9:,.0f} billion float32 multiply-adds/s."
        )
    if stopped := report.get("stopped"):
        lines.append(f"Not complete: {stopped}.")
    rows = [row for row in report["rows"] if "forward" in row]
    parts = [
        *((f"Ratios, {comparison(found)}", summary_lines(found)) for found in report["summaries"]),
        ("Times, forward / forward+backward [ms]", _times(rows)),
        ("Peak memory [MiB] / intersections [thousands] / host time of forward+backward [ms]", _resources(rows)),
        ("Error to float64: image RMS / image maximum / worst gradient", _errors(rows)),
        ("Stages [ms], and how many times their floor", _stages(rows)),
        ("Shapes that change, forward+backward, and the first call after a change [ms]", _changing(report["rows"])),
        ("CPU threads, thermosplat forward / forward+backward [ms]", _cores(rows)),
        ("Not measured", _failures(report["rows"])),
    ]
    for title, table in parts:
        body = list(table)
        if body:
            lines += ["", f"**{title}**", "", *body]
    return "\n".join(lines) + "\n"


def _names(rows: list[Row], key: str = "forward") -> list[str]:
    """What rows have an entry of under a key, in the order of first appearance; under "forward" renderers."""
    return list(dict.fromkeys(name for row in rows for name in row[key]))


def _table(head: list[str], body: list[list[str]]) -> Iterator[str]:
    if body:
        yield f"| {' | '.join(head)} |"
        yield "|" + "---|" * len(head)
        yield from (f"| {' | '.join(cells)} |" for cells in body)


def _place(row: Row) -> list[str]:
    return [f"{row['scene']} {row['size']}", row["case"]]


def _times(rows: list[Row]) -> Iterator[str]:
    names = _names(rows)
    pairs = [(name, ours) for name in names if name not in ALL_OURS for ours in ALL_OURS if ours in names]
    body = []
    for row in rows:
        cells = _place(row)
        for name in names:
            forward, both = (row[key].get(name, {}).get("median_ms") for key in ("forward", "forward_backward"))
            star = " *" if name in row["apart"] else ""
            cells.append("" if forward is None else f"{forward:.2f} / {both:.2f}{star}")
        for name, ours in pairs:
            both_there = name in row["forward"] and ours in row["forward"]
            medians = [(row[key][name], row[key][ours]) for key in ("forward", "forward_backward") if both_there]
            cells.append(" / ".join(f"{one['median_ms'] / other['median_ms']:.2f}" for one, other in medians))
        body.append(cells)
    yield from _table(["scene", "case", *names, *(f"{name} over {ours}" for name, ours in pairs)], body)
    for row in rows:
        for name, reason in row["apart"].items():
            yield f"\n\\* {' '.join(_place(row))}: {name} is not as near {OURS} as its conventions allow: {reason}."


def _resources(rows: list[Row]) -> Iterator[str]:
    names = _names(rows)
    body = []
    for row in rows:
        cells = _place(row)
        for name in names:
            memory, pairs = row["peak_memory_mib"].get(name), row["intersections"].get(name)
            host = row["forward_backward"].get(name, {}).get("host_ms")
            numbers = [
                "-" if memory is None else f"{memory:.0f}",
                "-" if pairs is None else f"{pairs / 1e3:,.1f}",
                "-" if host is None else f"{host:.2f}",
            ]
            cells.append(" / ".join(numbers) if name in row["forward"] else "")
        body.append([*cells, f"{row['results_mib']:.0f}" if "results_mib" in row else ""])
    yield from _table(["scene", "case", *names, "images and gradients [MiB]"], body)


def _errors(rows: list[Row]) -> Iterator[str]:
    rows = [row for row in rows if row["error_to_float64"]]
    names = _names(rows)
    body = []
    for row in rows:
        cells = _place(row)
        for name in names:
            found = row["error_to_float64"].get(name)
            if found is None:
                cells.append("")
                continue
            gradient = largest(value for key, value in found.items() if key.startswith("grad_"))
            cells.append(f"{found['image_rms']:.1e} / {found['image_max']:.1e} / {gradient:.1e}")
        body.append(cells)
    yield from _table(["scene", "case", *names], body)


def _stages(rows: list[Row]) -> Iterator[str]:
    rows = [row for row in rows if "stages" in row]
    names = _names(rows, "stages")
    body = []
    for row in rows:
        cells = [*_place(row), f"{row['fragments']['either'] / 1e6:.2f}"]
        for name in names:
            stage = row["stages"].get(name)
            cells.append("" if stage is None else f"{stage['median_ms']:.3f} ({stage['times_floor']:.1f}x)")
        whole = row["forward_backward"][OURS]["median_ms"]
        body.append([*cells, f"{whole:.3f} ({whole / row['floor_ms']:.1f}x)"])
    yield from _table(["scene", "case", "fragments [millions]", *names, "forward+backward through autograd"], body)


def _changing(rows: list[Row]) -> Iterator[str]:
    rows = [row for row in rows if "changing" in row]
    names = _names(rows, "changing")
    body = []
    for row in rows:
        found = [row["changing"].get(name) for name in names]
        times = ["" if t is None else f"{t['ms_per_call']['median_ms']:.2f}, {t['first_ms']:.2f}" for t in found]
        body.append([*_place(row), row["loop"], *times])
    yield from _table(["scene", "case", "loop", *names], body)


def _cores(rows: list[Row]) -> Iterator[str]:
    rows = [row for row in rows if "cores" in row]
    counts = _names(rows, "cores")
    body = []
    for row in rows:
        times = [row["cores"].get(count) for count in counts]
        pairs = ["" if t is None else f"{t['forward']:.1f} / {t['forward_backward']:.1f}" for t in times]
        body.append([*_place(row), *pairs])
    yield from _table(["scene", "case", *counts], body)


def _failures(rows: list[Row]) -> Iterator[str]:
    for row in rows:
        if "error" in row:
            yield f"- {' '.join(_place(row))}: {row['error']}"
        for name, reason in row.get("left_out", {}).items():
            yield f"- {' '.join(_place(row))}, {name}: {reason}"
        if "stages_error" in row:
            yield f"- {' '.join(_place(row))}, stages: {row['stages_error']}"
