"""``index.html`` of a result folder: its numbers, plots over the steps, strips and videos, on one page.

The page opens from the disk, without a server and without a network. It has no script. All text that comes from a
capture is escaped, and all links lead into the folder.
"""

import html
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from thermosplat import __version__
from thermosplat.config.yaml_files import read_yaml
from thermosplat.errors import UserError
from thermosplat.pictures.line_plot import Line, line_plot
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.runs.written_files import PAGE, PAGE_MARK, is_our_page
from thermosplat.spectra import BIAS, MAE, label, unit_label

_POLICY = "default-src 'none'; img-src 'self' file:; media-src 'self' file:; style-src 'unsafe-inline'"
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #1f2937; }
h1 { font-size: 1.6em; margin-bottom: 0; } h2 { font-size: 1.2em; margin-top: 2em; } .facts { color: #6b7280; }
table { border-collapse: collapse; } th, td { padding: .3em .9em; text-align: right; border-bottom: 1px solid #d1d5db; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(400px, 1fr)); gap: 1em; }
svg { width: 100%; height: auto; font: 12px system-ui, sans-serif; } svg text { fill: #4b5563; }
svg .title { font-weight: 600; } svg .grid { stroke: #e5e7eb; }
img, video { max-width: 100%; } figure { margin: 0 0 1.5em; } figcaption { color: #6b7280; }
@media (prefers-color-scheme: dark) {
  body { background: #111827; color: #e5e7eb; } th, td { border-color: #374151; }
  svg text { fill: #9ca3af; } svg .grid { stroke: #374151; } a { color: #93c5fd; }
}
"""
_LONGEST_LOG = 256 << 20
"""Bytes of metrics.jsonl that are read at all."""


def write_results_page(run: RunDirectory) -> Path | None:
    """Write ``index.html`` of a result folder; an earlier one of ours is replaced.

    Returns:
        The page; None where a file of that name is somebody else's, which stays.

    Raises:
        NotWrittenError: The page cannot be written.
    """
    path = run.path / PAGE
    if (path.exists() or path.is_symlink()) and not is_our_page(path):
        return None
    write_text(path, results_page(run))
    return path


def results_page(run: RunDirectory) -> str:
    """The page as HTML.

    Args:
        run: The result folder; what is missing or damaged in it is left out.
    """
    metrics = _json(run.metrics_json)
    rows = list(_lines(run.metrics_jsonl))
    name = run.path.resolve().name
    sections = [
        _numbers(metrics),
        _section("Over the steps", f'<div class="plots">{"".join(_plots(rows))}</div>' if rows else ""),
        _section("Videos", "".join(_videos(run.path))),
        _section("Held-out views", "".join(_strips(run.path))),
        _section("Files", _files(run.path)),
    ]
    return f"""<!doctype html>
{PAGE_MARK}
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>{html.escape(name)}</title><style>{_STYLE}</style></head><body>
<h1>{html.escape(name)}</h1>
<p class="facts">{html.escape(_origin(run))}</p>
<p class="facts">{html.escape(_facts(metrics))}</p>
{"".join(sections)}
<p class="facts">thermosplat {html.escape(__version__)}</p>
</body></html>
"""


def _section(title: str, content: str) -> str:
    return f"<h2>{html.escape(title)}</h2>\n{content}\n" if content else ""


def _origin(run: RunDirectory) -> str:
    """Of which capture the run is, where it lies, and when it ended."""
    try:
        capture = f"capture {Path(str(read_yaml(run.config_yaml)['data'])).name}"
    except (UserError, KeyError):
        capture = ""
    written = run.metrics_json if run.metrics_json.is_file() else run.config_yaml
    ended = datetime.fromtimestamp(written.stat().st_mtime).strftime("%Y-%m-%d %H:%M") if written.is_file() else ""
    return " · ".join(filter(None, (capture, str(run.path.resolve()), ended)))


def _facts(metrics: dict[str, Any]) -> str:
    """What the run was, in a line."""
    facts = []
    if _is_number(metrics.get("scenes")) and metrics["scenes"] > 1:
        facts.append(f"{metrics['scenes']:,.0f} scenes that became one")
    for key, form in (("steps", "{:,.0f} steps"), ("num_gaussians", "{:,.0f} Gaussians")):
        if _is_number(metrics.get(key)):
            facts.append(form.format(metrics[key]))
    if _is_number(metrics.get("train_seconds")):
        seconds = round(metrics["train_seconds"])
        facts.append(f"{seconds // 60} min {seconds % 60} s")
    if _is_number(metrics.get("model_bytes")):
        facts.append(f"{metrics['model_bytes'] / 1e6:.1f} MB")
    if isinstance(metrics.get("device"), str):
        facts.append(metrics["device"])
    return " · ".join(facts) or "not finished yet"


def _numbers(metrics: dict[str, Any]) -> str:
    """The table of the final numbers."""
    found = metrics.get("spectra")
    spectra = [name for name in found if isinstance(name, str)] if isinstance(found, list) else []
    measured = {name: values for name in spectra if isinstance(values := metrics.get(name), dict)}
    if not measured:
        return ""
    units = sorted({key.removeprefix(MAE) for values in measured.values() for key in values if key.startswith(MAE)})
    columns = [(f"{MAE}{unit}", f"MAE [{unit_label(unit)}]", ".3f") for unit in units]
    columns += [(f"{BIAS}{unit}", f"bias [{unit_label(unit)}]", "+.3f") for unit in units]
    columns += [("psnr", "PSNR [dB]", ".2f"), ("ssim", "SSIM", ".4f"), ("lpips", "LPIPS", ".4f")]
    columns = [column for column in columns if any(_is_number(values.get(column[0])) for values in measured.values())]
    head = "".join(f"<th>{html.escape(heading)}</th>" for _, heading, _ in columns)
    body = "".join(
        f"<tr><td>{html.escape(label(name))}</td>"
        + "".join(f"<td>{_cell(values.get(key), form)}</td>" for key, _, form in columns)
        + "</tr>"
        for name, values in measured.items()
    )
    return f"<table><thead><tr><th>Held-out views</th>{head}</tr></thead><tbody>{body}</tbody></table>\n"


def _plots(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Loss, PSNR of training and of held-out views, and the number of Gaussians."""
    training = sorted({key for row in rows for key in row if key.startswith("psnr_")})
    held_out: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        evaluation = row.get("evaluation")
        for name, values in evaluation.items() if isinstance(evaluation, dict) else ():
            if isinstance(values, dict) and _is_number(values.get("psnr")) and _is_number(row.get("step")):
                held_out.setdefault(f"{label(str(name))}, held-out", []).append((row["step"], values["psnr"]))
    by_spectrum = {label(key.removeprefix("psnr_")): _line(rows, key) for key in training}
    yield line_plot("Loss", {"loss": _line(rows, "loss")})
    yield line_plot("PSNR [dB]", by_spectrum | held_out)
    yield line_plot("Gaussians", {"Gaussians": _line(rows, "num_gaussians")})


def _line(rows: Iterable[dict[str, Any]], key: str) -> Line:
    return [(row["step"], row[key]) for row in rows if _is_number(row.get("step")) and _is_number(row.get(key))]


def _videos(root: Path) -> Iterator[str]:
    for path in _inside(root, "videos", "*.mp4"):
        video = f'<video controls preload="metadata" src="{_link(root, path)}"></video>'
        yield f"<figure>{video}{_caption(path.stem)}</figure>"


def _strips(root: Path) -> Iterator[str]:
    for path in _inside(root, "renders", "*.png"):
        source = _link(root, path)
        picture = f'<img loading="lazy" alt="{html.escape(path.stem)}" src="{source}">'
        yield f'<figure><a href="{source}">{picture}</a>{_caption(path.stem)}</figure>'


def _files(root: Path) -> str:
    """Links to what other programs open, and to the numbers."""
    found = [path for name in ("ply", "exports", "videos") for path in _inside(root, name, "*")]
    found += [path for name in ("metrics.json", "regions.json", "config.yaml") if (path := root / name).is_file()]
    items = (
        f'<li><a href="{_link(root, path)}">{html.escape(path.relative_to(root).as_posix())}</a>, '
        f"{_size(path.stat().st_size)}</li>"
        for path in found
    )
    return f"<ul>{''.join(items)}</ul>" if found else ""


def _size(number: int) -> str:
    """Bytes for people."""
    return f"{number / 1e6:.1f} MB" if number >= 100_000 else f"{max(number, 100) / 1e3:.1f} kB"


def _inside(root: Path, folder: str, pattern: str) -> list[Path]:
    """Plain files in a folder of the run; nothing that a link leads to."""
    if (root / folder).is_symlink():
        return []
    found = (root / folder).glob(pattern)
    return sorted(path for path in found if path.is_file() and not path.is_symlink() and path.name[0] != ".")


def _link(root: Path, path: Path) -> str:
    return html.escape(quote(path.relative_to(root).as_posix(), errors="surrogateescape"))


def _caption(text: str) -> str:
    printable = text.encode(errors="replace").decode()
    return f"<figcaption>{html.escape(printable)}</figcaption>"


def _cell(value: Any, form: str) -> str:
    return format(value, form) if _is_number(value) else "–"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    """Objects of a file of JSON lines; others are left out."""
    try:
        if path.stat().st_size > _LONGEST_LOG:
            return
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return
    for line in text.splitlines():
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(row, dict):
            yield row
