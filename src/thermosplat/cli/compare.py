"""thermosplat-compare: trained runs of several dates in one frame, and what changed between them."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from thermosplat.cli.command_line import check_ranges
from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import run_program


@dataclass(frozen=True)
class CompareArguments:
    """Compare runs of one place at several dates: what became warmer or colder, and what is gone or new.

    Examples:
      thermosplat-compare results/march/thermosplat_plus results/june/thermosplat_plus
      thermosplat-compare results/2024 results/2025 results/2026 --output comparison/roof
    """

    runs: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="BEFORE AFTER [LATER ...]")] = ()
    """Result folders of thermosplat-train, the first date first. All others are compared with the first."""
    data: tuple[str, ...] = ()
    """Where their captures lie now, in the same order. None: where they lay."""
    output: str = "comparison"
    """Folder for the page, the tables, the maps and the points."""
    gsd: float | None = None
    """Side of a pixel on the ground, in metres where the captures lie on the Earth, else in world units. None: a
    1500th of the map's longer side."""
    extent: tuple[float, float, float, float] | None = None
    """West, south, east and north of what is compared. None: what the first capture saw."""
    device: str = "auto"
    """"cuda", "cuda:1", "cpu", or "auto": CUDA where there is a device."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


def main(argv: list[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: Arguments without the program's name. None: the process's.

    Returns:
        The exit code.
    """
    return run_program(CompareArguments, _compare, argv, prog="thermosplat-compare")


def _compare(arguments: CompareArguments) -> int:
    check_ranges(arguments, extent=(-1e30, 1e30))
    with importing():
        from thermosplat.comparison.compare import compare
        from thermosplat.comparison.dates import in_one_frame, opened_dates

    opened, spectrum, photographs = opened_dates(arguments.runs, arguments.data, device=arguments.device)
    for run, capture in opened:
        for note in (*run.notes, *capture.notes):
            print(note)
    dates, said = in_one_frame(opened, photographs or spectrum)
    for sentence in said:
        print(sentence)
    folder = Path(os.path.expanduser(arguments.output))
    for sentence in compare(
        dates, spectrum, photographs, folder, pixel=arguments.gsd, extent=arguments.extent, sentences=said
    ):
        print(sentence)
    return 0


if __name__ == "__main__":
    sys.exit(main())
