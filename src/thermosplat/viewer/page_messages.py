"""What the page may say over its websocket. Whoever has the address can say anything there, not only the page.

viser believes its pages: limits of inputs hold in the browser alone, and a message may set any attribute of a control.
So every message is looked at before viser gets it. Kinds that this page never needs (uploads, forms, commands) do not
pass, nor do fields of another type, numbers that are not finite or out of all proportion, and choices that are not
among the options. Numbers beyond the limits of their input are moved to them.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any

from thermosplat.novel_views.bookmarks import FOVS, FURTHEST

LARGEST_MESSAGE = 64 << 10
"""Bytes. The page's own have a few hundred."""
A_SECOND = 200
"""Messages of a page that are taken in a second; the page itself sends 20 to 60 while something is dragged."""
KINDS = ("ViewerCameraMessage", "GuiUpdateMessage", "ScenePointerMessage", "SceneNodeClickMessage")
LARGEST_NUMBER = FURTHEST
"""Of places, directions and values."""
LARGEST_WINDOW = 16_384
"""Side of a browser's window [px]."""
_LONGEST_TEXT = 200
_DEEPEST = 8

Control = Any
"""viser's handle of an input, with its value and its limits."""


class Refused(Exception):
    """A message that no page of ours sends."""


def admitted(message: bytes | str, control: Callable[[str], Control | None]) -> bytes:
    """A message as viser may have it.

    Args:
        control: The input of a uuid; None where there is none.

    Returns:
        The message, with values within their limits.

    Raises:
        Refused: It may not pass.
    """
    import msgspec
    import viser._messages as known

    if not isinstance(message, bytes):
        raise Refused("a text")
    try:
        said = msgspec.msgpack.decode(message)
        kind = said.pop("type")
        if kind not in KINDS:
            raise Refused("a message of a kind that the page does not send")
        form = getattr(known, kind)
        msgspec.convert(said, form)
        said = {field.name: said[field.name] for field in dataclasses.fields(form) if field.name in said}
    except (msgspec.MsgspecError, AttributeError, KeyError, TypeError, RecursionError, UnicodeDecodeError) as error:
        raise Refused(f"a damaged message ({type(error).__name__})") from error
    for value in _values(said):
        if isinstance(value, str):
            if len(value) > LARGEST_MESSAGE // 16:
                raise Refused("a message with a long text")
        elif not isinstance(value, bool | int | float | None) or not abs(value or 0) <= LARGEST_NUMBER:
            raise Refused("a message with a number out of all proportion")
    if kind == "ViewerCameraMessage":
        _check_camera(said)
    elif kind == "ScenePointerMessage":
        needed = 1 if said["event_type"] == "click" else 2
        if len(said["screen_pos"]) != needed or (needed == 1 and None in (said["ray_origin"], said["ray_direction"])):
            raise Refused("a click without its place")
    elif kind == "GuiUpdateMessage":
        if set(said["updates"]) != {"value"}:
            raise Refused("a change of what is no value")
        said["updates"]["value"] = allowed(control(said["uuid"]), said["updates"]["value"])
    return msgspec.msgpack.encode({"type": kind, **said})


def allowed(control: Control | None, value: Any) -> Any:
    """A value that an input may have.

    Args:
        value: What a page says it is; numbers have been looked at.

    Returns:
        The value; a number is moved to the limits of its input, a text is cut.

    Raises:
        Refused: It is of another type, or not one of the options; the input cannot be used now, or is not there.
    """
    if control is None:
        raise Refused("a value of an input that is not there")
    now, options = control.value, getattr(control, "options", None)
    if getattr(control, "disabled", False):
        raise Refused("a value of an input that cannot be used now")
    if options is not None:
        if value not in options:
            raise Refused("a choice that is not offered")
        return value
    if isinstance(now, bool) or isinstance(value, bool):
        if type(value) is not type(now):
            raise Refused("a value of another type")
        return value
    if isinstance(now, str) and isinstance(value, str):
        return "".join(letter for letter in value if letter.isprintable())[:_LONGEST_TEXT]
    if not isinstance(now, int | float) or not isinstance(value, int | float):
        raise Refused("a value of another type")
    least, most = getattr(control, "min", None), getattr(control, "max", None)
    within = min(max(value, -math.inf if least is None else least), math.inf if most is None else most)
    return type(now)(within)


def _check_camera(said: dict[str, Any]) -> None:
    if not 0.5 <= math.hypot(*said["wxyz"]) <= 2.0:
        raise Refused("a camera without a rotation")
    if not FOVS[0] <= math.degrees(said["fov"]) <= FOVS[1]:
        raise Refused("a camera without a field of view")
    for side in ("image_width", "image_height"):
        said[side] = min(max(said[side], 1), LARGEST_WINDOW)


def _values(said: Any, depth: int = 0) -> Iterator[Any]:
    """Everything that stands in a message, without what holds it."""
    if depth > _DEEPEST:
        raise Refused("a message of many levels")
    if isinstance(said, dict | list | tuple):
        for part in said.values() if isinstance(said, dict) else said:
            yield from _values(part, depth + 1)
    else:
        yield said
