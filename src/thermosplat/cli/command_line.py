"""Words of a command line into a dataclass, with a --help that reads well, and --version."""

import ast
import dataclasses
import inspect
import textwrap
import typing
from collections.abc import Hashable
from functools import cache
from itertools import pairwise
from types import MappingProxyType
from typing import TypeVar

import tyro

from thermosplat import __version__
from thermosplat.errors import UserError
from thermosplat.printing import help_printed

Arguments = TypeVar("Arguments")


def parse_command_line(
    kind: type[Arguments], argv: list[str], *, prog: str, default: Arguments | None = None
) -> Arguments:
    """Understand a command line.

    Args:
        kind: Frozen dataclass; its docstring and those of its fields are the help.
        default: What holds where no flag says otherwise. None: the dataclass's defaults.

    Raises:
        SystemExit: Code 0 after --help or --version, code 2 after flags that tyro cannot understand.
    """
    if "--version" in argv:
        print(f"thermosplat {__version__}")
        raise SystemExit(0)
    join_lines_of_help(kind)  # type: ignore[arg-type]  # a class is hashable
    # tyro's own reading of the docstring ends before its examples
    description = inspect.cleandoc(kind.__doc__ or "")
    with help_printed(argv):
        if default is None:
            return tyro.cli(kind, prog=prog, args=argv, description=description)
        return tyro.cli(kind, prog=prog, args=argv, default=default, description=description)


def check_ranges(arguments: object, **ranges: tuple[float, float]) -> None:
    """Refuse numbers that a command cannot work with, NaN among them.

    Args:
        **ranges: Least and largest value by the argument's name, of a number or of each of several. None is always
            allowed.

    Raises:
        UserError: A number is out of its range.
    """
    for name, (least, most) in ranges.items():
        value = getattr(arguments, name)
        flag = f"--{name.replace('_', '-')}"
        for number in () if value is None else value if isinstance(value, tuple) else (value,):
            if not number >= least:
                raise UserError(f"{flag} must be at least {least:,}, found {number}.")
            if not number <= most:
                raise UserError(f"{flag} must be at most {most:,}, found {number}.")


@cache
def join_lines_of_help(kind: Hashable) -> None:
    """Let the text of every flag be one line, which tyro wraps: it keeps line breaks before indented lines."""
    described: dict[str, str] = {}
    for owner in reversed(inspect.getmro(kind)):  # type: ignore[arg-type]
        if dataclasses.is_dataclass(owner):
            described |= _texts_below_fields(owner)  # of a field that is declared anew, the text stays
            for field in dataclasses.fields(owner):
                if field.name in described:
                    field.metadata = MappingProxyType({**field.metadata, "help": described[field.name]})
                for kind in (field.type, *typing.get_args(field.type)):  # a group, or groups by name
                    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
                        join_lines_of_help(kind)


def _texts_below_fields(kind: type) -> dict[str, str]:
    """The strings that follow the fields in a class's source, in one line each."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    body = definition.body if isinstance(definition, ast.ClassDef) else []
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }
