"""thermosplat-compare: trained runs of several dates in one frame, and what changed between them."""

import os
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from thermosplat.cli.command_line import check_ranges
from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import program


@dataclass(frozen=True)
class CompareArguments:
    """Compare runs of one place at several dates: what became warmer or colder, and what is gone or new.

    Examples:
      thermosplat-compare results/march/thermosplat_plus results/june/thermosplat_plus
      thermosplat-compare results/2024 results/2025 results/2026 --output comparison/roof
      thermosplat-compare results/march flights/june
    """

    runs: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="BEFORE AFTER [LATER ...]")] = ()
    """Result folders of thermosplat-train, the first date first. All others are compared with the first. A capture, or
    a folder of untouched files, is prepared and trained as the first run was, in the folder of the comparison."""
    data: tuple[str, ...] = ()
    """Where their captures lie now, in the same order. None: where they lay."""
    output: str = "comparison"
    """Folder for the page, the tables, the maps and the points."""
    gsd: float | None = None
    """Side of a pixel on the ground, in metres where the captures lie on the Earth, else in world units. None: that
    of the thermal images, or a 1500th of the map's longer side if that is larger."""
    extent: tuple[float, float, float, float] | None = None
    """West, south, east and north of what is compared. None: what the first capture saw."""
    device: str = "auto"
    """"cuda", "cuda:1", "cpu", or "auto": CUDA where there is a device."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


def _compare(arguments: CompareArguments) -> int:
    check_ranges(arguments, extent=(-1e30, 1e30))
    with importing():
        from thermosplat.comparison.compare import compare
        from thermosplat.comparison.dates import in_one_frame, opened_dates

    folder = Path(os.path.expanduser(arguments.output))
    runs = [run_of(named, arguments, folder) for named in arguments.runs]
    opened, spectrum, photographs = opened_dates(runs, arguments.data, device=arguments.device)
    for run, capture in opened:
        for note in (*run.notes, *capture.notes):
            print(note)
    dates, said = in_one_frame(opened, photographs or spectrum)
    for sentence in said:
        print(sentence)
    for sentence in compare(
        dates, spectrum, photographs, folder, pixel=arguments.gsd, extent=arguments.extent, sentences=said
    ):
        print(sentence)
    return 0


def run_of(named: str, arguments: CompareArguments, output: Path) -> str:
    """The run that was named, or that of a folder with files: what was made of it before is not made again."""
    from thermosplat.datasets.colmap.model import find_model
    from thermosplat.datasets.transforms.reader import find_transforms
    from thermosplat.runs.run_directory import RunDirectory

    folder, like = (Path(os.path.expanduser(one)) for one in (named, arguments.runs[0]))
    if folder == like or not folder.is_dir() or RunDirectory(folder).holds_a_run():
        return named
    name = folder.resolve().name
    run = RunDirectory(output / "runs" / name)
    if run.metrics_json.is_file():
        return str(run.path)
    if find_model(folder) is None and find_transforms(folder) is None:
        _do("prepare", str(folder), "--out", str(folder := output / "captures" / name))
    if run.latest_checkpoint() is not None:
        _do("train", "--resume", str(run.path), "--data", str(folder))
    else:
        settings = ("--config", str(RunDirectory.open(like).config_yaml), "--device", arguments.device, "--overwrite")
        _do("train", str(folder), *settings, "--result-dir", str(run.path))
    return str(run.path)


def _do(*words: str) -> None:
    """Run another command in a process of its own, whose memory is free afterwards."""
    print(f"thermosplat-{shlex.join(words)}", flush=True)
    if code := subprocess.run([sys.executable, "-P", "-m", "thermosplat", *words], check=False).returncode:
        sys.exit(code)


main = program(CompareArguments, _compare, prog="thermosplat-compare")

if __name__ == "__main__":
    sys.exit(main())
