"""What bench_training.py measured, as lines of Markdown tables, which read well on a terminal too."""

from typing import Any

Report = dict[str, Any]

KERNELS = 12
"""Lines of the table of a case's kernels; the JSON file has more."""


def markdown(report: Report) -> str:
    """All tables, with what the numbers depend on.

    Args:
        report: As bench_training.py writes it to JSON.
    """
    environment = report["environment"]
    packages = environment["packages"]
    lines = [
        f"{environment['date']}, {environment['device']}, torch {packages['torch']}, Warp {packages['warp-lang']}, "
        f"kornia {packages['kornia']}, gsplat {environment['gsplat'] or 'not installed'}. `{environment['command']}`"
    ]
    if peaks := report.get("peaks"):
        lines.append(
            f"Measured peaks: {peaks['bytes_per_s'] / 1e9:,.0f} GB/s; float32 {peaks['flops_fp32'] / 1e12:,.1f}, TF32 "
            f"{peaks['flops_tf32'] / 1e12:,.1f}, float16 {peaks['flops_fp16'] / 1e12:,.1f} TFLOP/s."
        )
    if stopped := report.get("stopped"):
        lines.append(f"Not complete: {stopped}")
    for name in TABLES:
        if name in report:
            lines += ["", *lines_of(report, name)]
    return "\n".join(lines) + "\n"


def lines_of(report: Report, name: str) -> list[str]:
    """The lines of one part.

    Args:
        report: The report, which has that part.
        name: A key of ``TABLES``.
    """
    title, table = TABLES[name]
    part = report[name]
    if "error" in part:
        return [f"### {title}", "", f"Failed: {part['error']}"]
    return [f"### {title}", "", *table(part)]


def _table(head: list[str], rows: list[list[str]]) -> list[str]:
    return [_row(head), "|" + "---|" * len(head), *map(_row, rows)]


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:,.{digits}f}"


def _runs(part: Report) -> list[str]:
    head = ["training", "seed", "seconds", "first step", "late compilation", "without both", "ms a step", "steps"]
    head += ["Gaussians", "RGB PSNR", "thermal PSNR", "peak MiB", "late growth MiB"]
    rows = []
    for run in part["runs"]:
        names = [run.get("variant", "sample"), str(run.get("seed", "-"))]
        if "error" in run:
            rows.append([*names, f"failed: {run['error']}", *["-"] * (len(head) - 3)])
            continue
        samples, grown = run["memory"]["samples"], run["memory"]["late_growth_bytes"]
        rows.append(
            [
                *names,
                _number(run["seconds"], 1),
                _number(run["first_step_seconds"], 1),
                _number(run["late_compile_seconds"], 1),
                _number(run["compiled_seconds"], 1),
                _number(run["step_ms"], 2),
                f"{run['steps']:,}",
                f"{run['num_gaussians']:,}",
                _number(run["rgb_psnr"], 2),
                _number(run["thermal_psnr"], 2),
                _number(samples[-1]["memory_bytes"] / 2**20 if samples else None, 0),
                _number(None if grown is None else grown / 2**20, 1),
            ]
        )
    return _table(head, rows)


def _whole(part: Report) -> list[str]:
    lines = _runs(part)
    found = part.get("differences", {"to_plain": {}, "deterministic_equal": None})
    for seed, apart in found["to_plain"].items():
        lines += [
            "",
            f"Seed {seed}: PSNR minus the plain loop's: RGB {_signed(apart['rgb_psnr'])} dB, thermal "
            f"{_signed(apart['thermal_psnr'])} dB.",
        ]
    if (equal := found["deterministic_equal"]) is not None:
        lines += ["", f"Two trainings with --deterministic end with {'the same' if equal else 'other'} bits."]
    return lines


def _signed(value: float | None) -> str:
    return "-" if value is None else f"{value:+.3f}"


def _sample(part: Report) -> list[str]:
    (run,) = part["runs"]
    return [*_runs(part), "", f"On {run['cores']} cores; kernel cache {run['kernel_cache']} at the start."]


def _peers(part: Report) -> list[str]:
    rows = [
        [
            name,
            _number(times["milliseconds"], 2),
            _number(times["steps_per_second"], 1),
            f"{times['times_ours']:.2f}",
            f"{times['fastest_ms']:.2f} to {times['slowest_ms']:.2f}",
        ]
        for name, times in part["steps"].items()
    ]
    lines = [
        f"{part['capture']}, {part['size']}, {part['gaussians']:,} Gaussians; windows of {part['window']} steps in "
        f"turns; peer: {part['gsplat'] or 'none'}.",
        "",
        *_table(["training step", "ms", "steps/s", "time over ours", "windows, ms"], rows),
    ]
    if part["losses"]:
        worst, timed = (
            max(terms[key] for terms in part["losses"].values())
            for key in ("relative_difference", "timed_relative_difference")
        )
        verdict = part["disagreement"] or (
            f"losses agree: they differ by at most {worst:.1e} of themselves with decoders in float32 on both sides, "
            f"and by {timed:.1e} as timed"
        )
        lines += ["", f"On the same views {verdict}."]
    return lines


def _step(part: Report) -> list[str]:
    cases = part["cases"]
    if not cases:
        return ["Nothing measured."]
    head = ["ms (times its floor)"]
    head += [_name(case) for case in cases]
    rows = []
    for name in dict.fromkeys(name for case in cases for name in case["parts"]):
        both = any(case["parts"][name]["backward_ms"] is not None for case in cases if name in case["parts"])
        for direction in ("forward", "backward") if both else ("forward",):
            label = f"{name}, {direction}" if both else name
            rows.append([label, *(_part_cell(case["parts"].get(name), direction) for case in cases)])
    if errors := [case["parts_error"] for case in cases if "parts_error" in case]:
        rows.append([f"failed: {errors[0]}", *["-"] * len(cases)])
    rows.append(["rest", *(_number(case["rest_ms"], 3) for case in cases)])
    rows.append(["host gaps", *(_number(case["host_gap_ms"], 3) for case in cases)])
    rows.append(["step", *(_step_cell(case) for case in cases)])
    rows.append(["floor", *(_number(case["floor_ms"], 3) for case in cases)])
    rows.append(["peak MiB", *(_mebibytes(case, "allocated_bytes") for case in cases)])
    rows.append(["held MiB, with graphs", *(_mebibytes(case, "reserved_bytes") for case in cases)])
    lines = _table(head, rows)
    if fit := part["memory_model"]:
        lines += [
            "",
            f"Peak memory: {fit['bytes_per_gaussian']:,.0f} bytes a Gaussian, {fit['bytes_per_pixel']:,.0f} bytes a "
            f"pixel and {fit['bytes_besides'] / 2**20:,.0f} MiB, to {fit['largest_relative_error']:.1%}.",
        ]
    return [*lines, *_kernels(cases)]


def _part_cell(part: Report | None, direction: str) -> str:
    if part is None:
        return "-"
    took, floor = part[f"{direction}_ms"], part["floor"][f"{direction}_ms"]
    return f"{took:.3f} ({took / floor:.1f})"


def _step_cell(case: Report) -> str:
    floor = f" ({case['times_floor']:.1f})" if case["times_floor"] is not None else ""
    return f"{case['step_ms']:.3f}{floor}"


def _mebibytes(case: Report, name: str) -> str:
    return "-" if case["memory"] is None else _number(case["memory"][name] / 2**20, 0)


def _kernels(cases: list[Report]) -> list[str]:
    """Kernels of the step as it runs, by the part that their names tell."""
    names = list(dict.fromkeys(name for case in cases for name in case["in_step_ms"]))
    if not names:
        return []
    rows = [[name, *(_number(case["in_step_ms"].get(name), 3) for case in cases)] for name in names]
    lines = ["", *_table(["kernels in the step, ms", *map(_name, cases)], rows)]
    for case in cases:
        lines += ["", f"Costliest kernels, {_name(case)}:", ""]
        kernels = [
            [f"{kernel['microseconds']:.1f}", f"{kernel['calls']:.1f}", f"`{kernel['name'][:90]}`"]
            for kernel in case["kernels"][:KERNELS]
        ]
        lines += _table(["µs a step", "calls", "kernel"], kernels)
    return lines


def _name(case: Report) -> str:
    return f"{case['scene']} {case['width']}x{case['height']}, {case['gaussians']:,}"


TABLES = {
    "whole": ("Whole trainings", _whole),
    "peers": ("Steps side by side", _peers),
    "step": ("Where a step goes", _step),
    "sample": ("thermosplat-train sample on the CPU", _sample),
}
