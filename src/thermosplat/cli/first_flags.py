"""What ``thermosplat-train --help`` shows: the flags that people use first. ``--help-all`` shows every one."""

import dataclasses
import inspect
import typing
from collections.abc import Iterable
from typing import Annotated, Any

import tyro

from thermosplat.cli.command_line import join_lines_of_help
from thermosplat.config import TrainConfig
from thermosplat.printing import help_printed

FIRST = (
    *("data", "config", "result_dir", "overwrite", "resume", "max_steps", "budget"),
    *("data_factor", "lens", "test_every", "eval_steps", "save_steps", "refine", "without"),
    *("device", "devices", "gpu_memory", "viewer"),
)
"""Fields of ``TrainArguments``, in the order of the help (docs/api/configuration.md has the same)."""
FIRST_OF_SPECTRA = ("exposure",)
"""Likewise of every spectrum."""
ALL = "--help-all"


def print_first_flags(arguments: TrainConfig) -> None:
    """Print the help of the first flags.

    Args:
        arguments: What holds where no flag says otherwise; its class has the flags and the words above them.

    Raises:
        SystemExit: Code 0, always.
    """
    join_lines_of_help(type(arguments))  # type: ignore[arg-type]  # a class is hashable
    spectra = {name: _only(one, FIRST_OF_SPECTRA) for name, one in arguments.spectra.items()}
    groups = dataclasses.make_dataclass("Spectra", [_field(name, type(one), one) for name, one in spectra.items()])
    first = _only(arguments, FIRST, [_field("spectra", Annotated[groups, tyro.conf.arg(name="")], groups())])
    text = f"{inspect.cleandoc(type(arguments).__doc__ or '')}\n\nThe flags that people use first; all: {ALL}"
    with help_printed(["--help"]):
        tyro.cli(type(first), prog="thermosplat-train", args=["--help"], default=first, description=text)


def _only(whole: Any, names: Iterable[str], others: Iterable[Any] = ()) -> Any:
    """The values of some fields of a dataclass, and other fields, as a dataclass of their own."""
    fields = {field.name: field for field in dataclasses.fields(whole)}
    hints = typing.get_type_hints(type(whole), include_extras=True)
    chosen = [_field(name, hints[name], getattr(whole, name), fields[name].metadata) for name in names]
    return dataclasses.make_dataclass(type(whole).__name__, [*chosen, *others], frozen=True)()


def _field(name: str, kind: Any, value: Any, metadata: Any = None) -> Any:
    return name, kind, dataclasses.field(default_factory=lambda: value, metadata=metadata)
