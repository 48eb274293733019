"""The report of bench_training.py as Markdown, for benchmarks/records/."""

from collections.abc import Iterator
from typing import Any

from thermosplat.spectra import label

Row = dict[str, Any]


def markdown(report: dict[str, Any]) -> str:
    """All tables of a report.

    Args:
        report: as written to the JSON file; parts that are not there are left out.
    """
    machine = report["environment"]
    packages = machine["packages"]
    versions = ", ".join(f"{name} {packages[name]}" for name in ("torch", "gsplat") if packages.get(name))
    lines = [f"{report['date']}, {machine['device']}, {versions}. `{report['command']}`"]
    if peaks := report.get("peaks"):
        lines.append(
            f"Measured peaks: {peaks['bytes_per_s'] / 1e9:,.0f} GB/s; float32 {peaks['flops_fp32'] / 1e12:,.1f}, TF32 "
            f"{peaks['flops_tf32'] / 1e12:,.1f}, float16 {peaks['flops_fp16'] / 1e12:,.1f} TFLOP/s."
        )
    steps = [*report.get("step", []), *(row for row in report.get("sizes", []) if "parts" in row)]
    parts = [
        ("Whole runs", _whole(report.get("whole", []))),
        ("The sample on the CPU", _sample(report.get("sample"))),
        ("Memory over a whole run", _growth(report.get("whole", []))),
        ("Steps per second on the same Gaussians", _peers(report.get("peers"))),
        ("A step [ms]", _steps(steps)),
        ("Where a step goes: ms (times its floor)", _parts(steps)),
        ("Parts alone, forward + backward: ms (times the floor of both)", _alone(steps)),
        ("Densification", _densification(report.get("densification"))),
        ("Peak memory", _memory(report)),
        ("Not measured", _failures(report)),
    ]
    for title, table in parts:
        body = list(table)
        if body:
            lines += ["", f"**{title}**", "", *body]
    return "\n".join(lines) + "\n"


def _table(head: list[str], body: list[list[str]]) -> Iterator[str]:
    if body:
        yield f"| {' | '.join(head)} |"
        yield "|" + "---|" * len(head)
        yield from (f"| {' | '.join(cells)} |" for cells in body)


def _whole(rows: list[Row]) -> Iterator[str]:
    head = [
        "run",
        "seed",
        "s to metrics.json",
        "of these first step, later compilation",
        "without both",
        "ms per step",
        "Gaussians",
    ]
    spectra = list(dict.fromkeys(name for row in rows for name in row.get("psnr", {})))
    head += [f"PSNR {label(name)}" for name in spectra]
    body = []
    for row in rows:
        if "error" not in row:
            cells = [row["kind"], str(row.get("seed", "-")), f"{row['seconds']:.1f}"]
            cells += [f"{row['first_step_s']:.1f}, {row['late_compile_s']:.1f}"]
            cells += [f"{row['seconds_without_compilation']:.1f}"]
            cells += [f"{row['ms_a_step']:.2f}{_cost(row)}", f"{row['num_gaussians']:,}"]
            body.append(cells + [_psnr(row, name) for name in spectra])
    yield from _table(head, body)
    for row in rows:
        if "same_bits_twice" in row:
            yield f"\n{row['kind']}, seed {row['seed']}: the same bits in two runs: {row['same_bits_twice']}."


def _sample(row: Row | None) -> Iterator[str]:
    if row is None:
        return
    yield from _whole([row])
    cache = "an empty" if row["cold"] else "the user's"
    yield f"\n`thermosplat-train sample` on {row['cores']} cores, with {cache} cache of compiled kernels."


def _cost(row: Row) -> str:
    return f" ({row['times_default']:.2f}x)" if "times_default" in row else ""


def _psnr(row: Row, spectrum: str) -> str:
    if spectrum not in row["psnr"]:
        return "-"
    apart = row.get("psnr_from_default", {}).get(spectrum)
    return f"{row['psnr'][spectrum]:.2f}" + ("" if apart is None else f" ({apart:+.3f})")


def _growth(rows: list[Row]) -> Iterator[str]:
    body = []
    for row in rows:
        if "error" not in row:
            cells = [f"{found['memory_bytes'] / 2**20:,.0f} MiB, {found['num_gaussians']:,}" for found in row["memory"]]
            body.append([f"{row['kind']}, seed {row['seed']}", *cells])
    yield from _table(["run", "peak, Gaussians at 30% of the steps", "50%", "100%"], body)


def _peers(found: Row | None) -> Iterator[str]:
    if found is None:
        return
    body = [
        [name, f"{row['steps_per_s']:.1f}", f"{row['median_ms']:.2f}", f"{row['times_ours']:.2f}x"]
        for name, row in found["peers"].items()
    ]
    count = f"{found['num_gaussians']:,} Gaussians"
    yield from _table([count, "steps/s", "ms per step", "of ours"], body)


def _steps(rows: list[Row]) -> Iterator[str]:
    body = []
    for row in rows:
        gap = "-" if row["host_gap_ms"] is None else f"{row['host_gap_ms']:.2f}"
        cells = [row["name"], row["size"], f"{row['num_gaussians']:,}", f"{row['pairs']:,.0f}"]
        body.append([*cells, f"{row['median_ms']:.2f}", f"{row['kernels_ms']:.2f}", gap, f"{row['floor_ms']:.2f}"])
    yield from _table(["scene", "size", "Gaussians", "pairs", "step", "kernels", "idle", "floors"], body)


def _parts(rows: list[Row]) -> Iterator[str]:
    names = list(dict.fromkeys(part for row in rows for part in row["parts"]))
    body = [[f"{row['name']} {row['size']}", *(_part(row["parts"].get(name)) for name in names)] for row in rows]
    yield from _table(["scene", *names], body)


def _part(found: Row | None) -> str:
    if found is None or (found["ms"] is None and "floor_ms" not in found):
        return "-"
    if found["ms"] is None:
        return f"- (floor {found['floor_ms']:.3f})"
    return f"{found['ms']:.3f}" + (f" ({found['times_floor']:.1f}x)" if "times_floor" in found else "")


def _alone(rows: list[Row]) -> Iterator[str]:
    names = list(dict.fromkeys(part for row in rows for part in row["alone"]))
    body = [
        [f"{row['name']} {row['size']}", *(_alone_part(row["alone"].get(name)) for name in names)]
        for row in rows
        if row["alone"]
    ]
    yield from _table(["scene", *names], body)


def _alone_part(found: Row | None) -> str:
    if found is None:
        return "-"
    backward = "" if found["backward_ms"] is None else f" + {found['backward_ms']:.3f}"
    return f"{found['forward_ms']:.3f}{backward} ({found['times_floor']:.1f}x)"


def _densification(found: Row | None) -> Iterator[str]:
    if found is not None:
        yield (
            f"A refinement adds {found['refinement_ms']:.1f} ms (median of {found['timed']}) every "
            f"{found['every']} steps: {found['ms_a_step']:.3f} ms per step while there are any."
        )


def _memory(report: dict[str, Any]) -> Iterator[str]:
    rows = [row for row in report.get("sizes", []) if row.get("memory_mib") is not None]
    body = [
        [f"{row['num_gaussians']:,}", row["size"], f"{row['memory_mib']:,.0f}", f"{row['reserved_mib']:,.0f}"]
        for row in rows
    ]
    yield from _table(["Gaussians", "size", "peak [MiB]", "reserved with graph [MiB]"], body)
    if fit := report.get("memory"):
        yield (
            f"\nLeast squares: {fit['bytes_a_gaussian']:,.0f} bytes per Gaussian, {fit['bytes_a_pixel']:,.0f} per "
            f"pixel, {fit['bytes_besides'] / 2**20:,.0f} MiB besides; worst residual {fit['worst_mib']:,.0f} MiB."
        )


def _failures(report: dict[str, Any]) -> Iterator[str]:
    for row in (*report.get("whole", []), *filter(None, [report.get("sample")])):
        if "error" in row:
            yield f"- {row['kind']}, seed {row.get('seed', '-')}: {row['error'].splitlines()[-1]}"
    yield from (f"- {name}: {why}" for name, why in (report.get("peers") or {}).get("left_out", {}).items())
    for row in (*report.get("step", []), *report.get("sizes", [])):
        if "alone_error" in row:
            yield f"- parts alone of {row['name']} {row['size']}: {row['alone_error']}"
    yield from (f"- {name}: {why}" for name, why in report["errors"].items())
    yield from (f"- {name}: the time limit" for name in report["stopped"])
