"""How exact is the rasterizer where rasterizers break? Beside gsplat 1.5.3 where that is installed.

    python benchmarks/bench_accuracy.py --device cpu --json accuracy.json
    python benchmarks/bench_accuracy.py --device cuda --cases needles "5,000"

One row per scene and renderer: the largest error of the image and the relative error of each gradient, of float32
against a dense float64 renderer that shares no code with the kernels (reference_rasterizer.py of tests/fixtures; the
scenes are in hard_scenes.py there). A star marks where thermosplat's error exceeds gsplat's by more than a rounding of
float32. On CUDA the peer is gsplat's extension, on the CPU its torch reference.
"""

import argparse
import json
import math
import platform
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import warp as wp

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "fixtures"))
import gsplat_reference
from hard_scenes import FINITE, LARGE, NON_FINITE
from measuring.agreement import largest
from scenes.accuracy_truth import Rasterization, Truth, errors, truth_of
from thermosplat import rasterization
from thermosplat.runs.atomic_writes import write_text

COLUMNS = ("image", "means", "quats", "scales", "covars", "opacities", "colors", "viewmats")
ROUNDING = 2.0**-23
"""Differences below this are a matter of luck."""


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--cases", nargs="+", default=None, help="parts of names; all if not given")
    parser.add_argument("--json", type=Path, default=None, help="file to write")
    parser.add_argument("--markdown", type=Path, default=None, help="file to write: images and worst gradients")
    parser.add_argument("--no-peer", action="store_true", help="thermosplat alone")
    return parser.parse_args()


def chosen(parts: list[str] | None) -> list[str]:
    """Names of the scenes to run, those with non-finite numbers last: what they do to a peer hurts no other row."""
    names = [name for name in (*FINITE, *NON_FINITE) if parts is None or any(part in name for part in parts)]
    if not names:
        sys.exit(f"no case has {' or '.join(map(repr, parts or []))} in its name; cases: {', '.join(FINITE)}, ...")
    return names


def gsplat_peer(options: argparse.Namespace) -> tuple[str, Rasterization] | str:
    """gsplat by name, or why there is none."""
    if options.no_peer:
        return "left out"
    try:
        if options.device == "cuda":
            from gsplat import rasterization as cuda

            return f"gsplat {version('gsplat')}, CUDA", lambda **scene: cuda(**scene, packed=False)
        reference = gsplat_reference.install()
    except ImportError as error:
        return f"not importable ({error})"

    def render(**scene: Any) -> Any:
        return reference(**{key: value for key, value in scene.items() if key != "camera_model"})

    return f"gsplat {version('gsplat')}, torch reference", render


def measured(render: Rasterization, truth: Truth, device: torch.device, dtype: torch.dtype) -> dict[str, Any]:
    """The errors, or why there are none."""
    try:
        return errors(render, truth, device, dtype)
    except (RuntimeError, ValueError, TypeError, AssertionError, IndexError) as error:
        return {"failed": f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:100]}"}


def exceeds(ours: float, theirs: float | None) -> bool:
    """Whether ours is the larger error; a number is better than none."""
    if theirs is None or theirs != theirs:
        return False
    return not ours <= theirs + ROUNDING


def print_row(name: str, renderer: str, found: dict[str, Any], peer: dict[str, Any] | None) -> None:
    """One line; ``peer`` holds what thermosplat's errors are held against."""
    print(f"{name:<44} {renderer:<12}", end="")
    if "failed" in found:
        print(f" {found['failed']}", flush=True)
        return
    for column in COLUMNS:
        value = found.get(column)
        text = "" if value is None else f"{value:.1e}"
        star = "*" if value is not None and peer is not None and exceeds(value, peer.get(column)) else ""
        print(f" {text + star:>9}", end="")
    print(flush=True)


def write_json(path: Path | None, report: dict[str, Any]) -> None:
    """Replaces the file, so that it is whole at any time."""
    if path is not None:
        # Standard JSON has no NaN: what is not finite becomes a string.
        text = json.dumps(_json(report), indent=1, allow_nan=False)
        write_text(path, text + "\n")


def markdown(rows: dict[str, dict[str, Any]]) -> str:
    """A table of the images' errors and of each renderer's worst gradient; what is the smaller error is bold."""
    lines = ["| scene | image | gsplat | worst gradient | gsplat |", "|---|---|---|---|---|"]
    for name, row in rows.items():
        cells = []
        for key in ("image", "gradient"):
            both = [_worst(row[renderer], key) for renderer in ("thermosplat", "gsplat")]
            best = min((value for value, _ in both if math.isfinite(value)), default=math.nan)
            for value, text in both:
                cells.append(f"**{text}**" if value == best else text)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _worst(found: dict[str, Any] | None, key: str) -> tuple[float, str]:
    if found is None or "failed" in found:
        return math.nan, "" if found is None else "does not run"
    if key == "image":
        return found[key], f"{found[key]:.1e}"
    gradients = {name: found[name] for name in COLUMNS[1:] if name in found}
    wrong = [name for name, value in gradients.items() if not math.isfinite(value)]
    if wrong:
        return math.nan, f"NaN: {', '.join(wrong)}"
    name = max(gradients, key=lambda name: gradients[name])
    return gradients[name], f"{gradients[name]:.1e} {name}"


def _json(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _json(item) for key, item in value.items()}
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def main() -> int:
    """Runs the cases; returns 1 if thermosplat failed in one or left something that is not finite."""
    options = arguments()
    device = torch.device(options.device)
    names = chosen(options.cases)
    peer = gsplat_peer(options)
    report: dict[str, Any] = {
        "environment": {
            "command": " ".join(sys.argv),
            "date": time.strftime("%Y-%m-%d"),
            "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "cpu",
            "torch": torch.__version__,
            "warp": wp.__version__,
            "gsplat": peer if isinstance(peer, str) else peer[0],
        },
        "rows": {},
    }
    rows: dict[str, dict[str, Any]] = report["rows"]
    # All of thermosplat's first: a peer that crashes on a number that is not finite takes the process with it.
    for name in names:
        truth = truth_of(name, device)
        rows[name] = {
            "certain": float(truth.certain.double().mean()),
            "float64": measured(rasterization, truth, device, torch.float64),
            "thermosplat": measured(rasterization, truth, device, torch.float32),
        }
        write_json(options.json, report)
    print(f"{'case':<44} {'renderer':<12}", *(f"{column:>9}" for column in COLUMNS))
    for name in names:
        if isinstance(peer, str):
            rows[name]["gsplat"] = None
        elif name in LARGE and device.type == "cpu":
            rows[name]["gsplat"] = {"failed": "left out: the torch reference needs minutes for so many pixels"}
        else:
            rows[name]["gsplat"] = measured(peer[1], truth_of(name, device), device, torch.float32)
        theirs = rows[name]["gsplat"]
        print_row(name, "thermosplat", rows[name]["thermosplat"], theirs)
        if theirs is not None:
            print_row("", "gsplat", theirs, None)
        write_json(options.json, report)
    if options.markdown is not None:
        write_text(options.markdown, markdown(rows))
    kernels = [value for row in rows.values() for value in row["float64"].values() if not isinstance(value, str)]
    print(f"gsplat: {report['environment']['gsplat']}. Our kernels in float64 are at most {largest(kernels):.1e} off.")
    ours = [row["thermosplat"] for row in rows.values()]
    sound = all("failed" not in row and all(math.isfinite(value) for value in row.values()) for row in ours)
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
