"""Filling the configuration's dataclasses from plain values, strictly: unknown keys and wrong types are errors."""

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterable
from typing import Any, Literal, TypeVar

from thermosplat.errors import UserError

Config = TypeVar("Config")


def fill(default: Config, values: dict[str, Any], *, source: str, prefix: str = "") -> Config:
    """A copy of a configuration dataclass with some fields replaced.

    Args:
        default: Frozen dataclass that gives the fields not named in ``values``.
        values: Field names to plain values; nested dictionaries for nested dataclasses.
        prefix: Dotted path of ``default`` inside the whole configuration, for error messages.

    Raises:
        UserError: A key that is no field, or a value that does not fit the field's type.
    """
    annotations = typing.get_type_hints(type(default))
    changes: dict[str, Any] = {}
    for key, value in values.items():
        if key not in annotations:
            raise UserError(f'{source}: unknown key "{shortened(f"{prefix}{key}")}"{nearest(str(key), annotations)}.')
        current = getattr(default, key)
        where = f"{prefix}{key}"
        if (kind := _group_kind(annotations[key])) is not None:
            changes[key] = _fill_groups(current, kind, value, source=source, where=where)
        elif not dataclasses.is_dataclass(current):
            changes[key] = _converted(value, annotations[key], source=source, where=where)
        elif isinstance(value, dict):
            changes[key] = fill(current, value, source=source, prefix=f"{where}.")
        else:
            raise UserError(f'{source}: "{where}" is a group of settings, found {shown(value)}.')
    return dataclasses.replace(default, **changes)  # type: ignore[type-var]


def _group_kind(annotation: Any) -> Any:
    """The dataclass of the groups of settings by name that a field holds; None for another field."""
    arguments = typing.get_args(annotation)
    is_groups = typing.get_origin(annotation) is dict and dataclasses.is_dataclass(arguments[1])
    return arguments[1] if is_groups else None


def _fill_groups(current: dict[str, Any], kind: type, values: Any, *, source: str, where: str) -> dict[str, Any]:
    """Groups of settings by name: those named in ``values`` are changed, or start from the dataclass's defaults."""
    if not isinstance(values, dict):
        raise UserError(f'{source}: "{where}" holds groups of settings by name, found {shown(values)}.')
    groups = dict(current)
    for name, value in values.items():
        if not isinstance(value, dict):
            raise UserError(f'{source}: "{where}.{name}" is a group of settings, found {shown(value)}.')
        start = groups.get(str(name), kind())
        groups[str(name)] = fill(start, value, source=source, prefix=f"{where}.{name}.")
    return groups


def shown(value: Any) -> str:
    """A value as it is shown in a message: as Python writes it, cut to some 60 characters.

    Args:
        value: Any value, such as a text of megabytes or a number of thousands of digits.
    """
    try:
        return shortened(repr(value))
    except (ValueError, RecursionError):  # Python does not write integers of more than 4,300 digits
        return f"a {type(value).__name__} that is too long to show"


_SHOWN = 60


def shortened(text: str) -> str:
    """A text as it is shown in a message: cut to some 60 characters."""
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def nearest(word: str, known: Iterable[str]) -> str:
    """ ", did you mean ...?" for the known word closest to a mistyped one, or nothing where none is close."""
    if len(word) > _SHOWN:
        return ""
    by_lower_case = {name.lower(): name for name in known}
    close = difflib.get_close_matches(word.lower(), list(by_lower_case), n=1, cutoff=0.6)
    return f' (did you mean "{by_lower_case[close[0]]}"?)' if close else ""


def _converted(value: Any, annotation: Any, *, source: str, where: str) -> Any:
    fitting = _fit(value, annotation)
    if fitting is _MISFIT:
        suggestion = ""
        if typing.get_origin(annotation) is Literal and isinstance(value, str):
            suggestion = nearest(value, typing.get_args(annotation))
        raise UserError(f'{source}: "{where}" must be {_described(annotation)}, found {shown(value)}{suggestion}.')
    return fitting


_MISFIT = object()
_LARGEST = 2**63 - 1
"""What tensors and files take as a whole number."""


def _fit(value: Any, annotation: Any) -> Any:
    """The value as the annotation's type, or _MISFIT."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (types.UnionType, typing.Union):
        candidates = (_fit(value, argument) for argument in arguments)
        return next((fitting for fitting in candidates if fitting is not _MISFIT), _MISFIT)
    if origin is Literal:
        return value if value in arguments else _MISFIT
    if origin is tuple:
        return _fit_tuple(value, arguments)
    if annotation is type(None):
        return None if value is None else _MISFIT
    if annotation is float and isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:  # an integer of more than 308 digits
            return _MISFIT
    if annotation is int and (isinstance(value, bool) or (isinstance(value, int) and abs(value) > _LARGEST)):
        return _MISFIT  # a bool is an int to Python, not to a user
    return value if isinstance(value, annotation) else _MISFIT


def _fit_tuple(value: Any, arguments: tuple[Any, ...]) -> Any:
    if not isinstance(value, list | tuple):
        return _MISFIT
    if arguments[-1] is Ellipsis:
        arguments = arguments[:1] * len(value)
    if len(arguments) != len(value):
        return _MISFIT
    items = tuple(_fit(item, argument) for item, argument in zip(value, arguments))
    return _MISFIT if any(item is _MISFIT for item in items) else items


def _described(annotation: Any) -> str:
    """A type in words."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(_described(argument) for argument in arguments)
    if origin is Literal:
        return "one of " + ", ".join(f'"{choice}"' for choice in arguments)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"a list, each item {_described(arguments[0])}"
        return f"a list of {len(arguments)}, each {_described(arguments[0])}"
    words = {bool: "true or false", int: "a whole number", float: "a number", str: "text", type(None): "null"}
    return words[annotation]
