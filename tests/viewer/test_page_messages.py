"""What a page says is taken as a page of ours says it: clamped, or refused; never passed on as it came."""

import math
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

if find_spec("viser") is None:
    pytest.skip("viser is not installed (the extra viewer)", allow_module_level=True)

import msgspec

from page_client import CAMERA
from thermosplat.viewer.page_messages import Refused, admitted, allowed

NUMBER = SimpleNamespace(value=1920, min=16, max=8192, disabled=False)
FREE = SimpleNamespace(value=0.5, min=None, max=None)
CHOICE = SimpleNamespace(value="one", options=("one", "two"))
CLICK = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": [0.0, 0.0, 0.0],
    "ray_direction": [0.0, 0.0, 1.0],
    "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}
NODE = {"type": "SceneNodeClickMessage", "name": "/frames/1", "instance_index": None, "ray_origin": [0, 0, 0],
        "ray_direction": [0, 0, 1], "screen_pos": [0.5, 0.5], "modifier": "shift", "owner": "x"}  # fmt: skip


def taken(message: Any, control: Any = None) -> dict[str, Any]:
    """What viser gets of a message."""
    content = message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message)
    return msgspec.msgpack.decode(admitted(content, lambda uuid: control if uuid == "a" else None))


@pytest.mark.parametrize("message", [CAMERA, CLICK, NODE])
def test_what_our_page_says_passes(message: dict[str, Any]) -> None:
    """As it is."""
    assert taken(message) == message


@pytest.mark.parametrize(
    "change",
    [
        {"fov": 0.0},
        {"fov": -1.0},
        {"fov": math.pi},
        {"fov": "1"},
        {"fov": None},
        {"fov": True},
        {"wxyz": [0.0, 0.0, 0.0, 0.0]},
        {"wxyz": [1e300, 0.0, 0.0, 0.0]},
        {"wxyz": [1.0, 0.0, 0.0]},
        {"position": [1e300, 0.0, 0.0]},
        {"position": [math.nan, 0.0, 0.0]},
        {"position": [[0.0], 0.0, 0.0]},
        {"position": "abc"},
        {"look_at": [math.inf, 0.0, 0.0]},
        {"up_direction": [0.0, -math.inf, 0.0]},
        {"near": math.nan},
        {"far": 1e30},
        {"image_width": 1.5},
        {"image_width": None},
        {"image_height": 2**63},
    ],
)
def test_a_camera_that_is_none_is_refused(change: dict[str, Any]) -> None:
    """No rotation, no field of view, places out of all proportion, other types, a field that is missing."""
    with pytest.raises(Refused):
        taken({**CAMERA, **change})
    with pytest.raises(Refused):
        taken({key: value for key, value in CAMERA.items() if key not in change})


def test_a_window_has_a_size() -> None:
    """None of a hidden tab is one pixel; one of 10^8 is the largest."""
    said = taken({**CAMERA, "image_width": 0, "image_height": 10**8, "unknown": 1})
    assert (said["image_width"], said["image_height"], "unknown" in said) == (1, 16384, False)


@pytest.mark.parametrize(
    ("control", "value", "expected"),
    [
        (NUMBER, 20_000, 8192),
        (NUMBER, -5, 16),
        (NUMBER, 640.7, 640),
        (NUMBER, 1e9, 8192),
        (FREE, 3, 3.0),
        (FREE, -1e9, -1e9),
        (CHOICE, "two", "two"),
        (SimpleNamespace(value=False), True, True),
        (SimpleNamespace(value=""), "a\x1b[31m\n\u202eb" + "c" * 1000, "a[31mb" + "c" * 194),
    ],
)
def test_a_value_is_moved_to_the_limits_of_its_input(control: Any, value: Any, expected: Any) -> None:
    """They hold here, not in the browser; a value has the type that its input has."""
    update = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": value}}
    found = taken(update, control)["updates"]["value"]
    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("control", "value"),
    [
        (CHOICE, "three"),
        (CHOICE, None),
        (CHOICE, ["one"]),
        (CHOICE, 0),
        (NUMBER, "9"),
        (NUMBER, None),
        (NUMBER, True),
        (NUMBER, [9]),
        (NUMBER, {}),
        (FREE, math.nan),
        (FREE, -math.inf),
        (FREE, 1e10),
        (SimpleNamespace(value=False), 1),
        (SimpleNamespace(value=False), "true"),
        (SimpleNamespace(value=""), 5),
        (SimpleNamespace(value=""), b"x"),
        (SimpleNamespace(value=(1, 2)), [1, 2]),
        (SimpleNamespace(value=True, disabled=True), True),
        (None, 1),
    ],
)
def test_a_value_that_no_page_gives_is_refused(control: Any, value: Any) -> None:
    """Choices that are not offered, other types, numbers that are none, inputs that are off or not there."""
    with pytest.raises(Refused):
        taken({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": value}}, control)


@pytest.mark.parametrize(
    "message",
    [
        "text",
        b"",
        b"\xc1",
        b"\x91" * 5000,
        b"\x81\xa4type\xff",
        b"\xdf\xff\xff\xff\xff",
        5,
        [],
        {},
        {"type": 5},
        {"type": None},
        {"type": []},
        {"type": "Message"},
        {"type": "FileTransferStartUpload", "source_component_uuid": "a", "transfer_uuid": "t", "filename": "x",
         "mime_type": "", "part_count": 10**9, "size_bytes": 10**12},
        {"type": "FileTransferPart", "source_component_uuid": "a", "transfer_uuid": "t", "part_index": 0,
         "content": b"x" * 1000},
        {"type": "ShareUrlRequest"},
        {"type": "GuiFormDirtyMessage", "uuid": "a"},
        {"type": "CommandTriggerMessage", "uuid": "a"},
        {"type": "RunJavascriptMessage", "source": "1"},
        {"type": "GuiUpdateMessage", "uuid": "a", "updates": {}},
        {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"removed": True}},
        {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 5, "update_cb": []}},
        {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"sync_cb": 1}},
        {"type": "GuiUpdateMessage", "uuid": ["a"], "updates": {"value": 5}},
        {"type": "GuiUpdateMessage", "uuid": "a" * 10_000, "updates": {"value": 5}},
        {**CLICK, "screen_pos": []},
        {**CLICK, "screen_pos": [[0.5]]},
        {**CLICK, "screen_pos": [[0.5, math.nan]]},
        {**CLICK, "ray_origin": None},
        {**CLICK, "event_type": "rect-select"},
        {**CLICK, "event_type": "drag"},
        {**CLICK, "modifier": "x" * 10_000},
        {**NODE, "name": 5},
        {**NODE, "ray_origin": [math.inf, 0, 0]},
    ],
)  # fmt: skip
def test_what_no_page_of_ours_says_is_refused(message: Any) -> None:
    """Damaged messages, kinds that this page never needs, attributes of controls other than their values."""
    with pytest.raises(Refused) as refused:
        taken(message, NUMBER)
    assert len(str(refused.value)) < 100


def test_any_bytes_are_refused_or_right() -> None:
    """Damaged cameras: what passes is a camera."""
    rng = np.random.default_rng(0)
    good = bytearray(msgspec.msgpack.encode(CAMERA))
    for _ in range(500):
        damaged = good.copy()
        for at in rng.integers(0, len(good), 3):
            damaged[at] = rng.integers(0, 256)
        try:
            said = taken(bytes(damaged))
        except Refused:
            continue
        assert np.isfinite([*said["wxyz"], *said["position"], said["fov"]]).all()


def test_an_input_may_be_any_of_visers() -> None:
    """An input without limits and options, such as a check box, is asked for none."""
    assert allowed(SimpleNamespace(value=True), False) is False
