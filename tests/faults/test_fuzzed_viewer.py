"""Pages that say anything, and requests that are anything: the viewer goes on, within its limits, without a traceback.

Pictures are small here, so that thousands of cases take minutes. What is large is refused before anything is made.
"""

import io
import socket
import sys
import threading
import time
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fuzzing import EXTREMES, Fuzzer, changed_bytes, main, number_of_cases, run_apart
from viewed_toy import viewed_toy

if find_spec("viser") is None:
    pytest.skip("viser is not installed (the extra viewer)", allow_module_level=True)

import msgspec

from page_client import CAMERA, PageClient
from thermosplat.viewer import picture_sizes, visitor
from thermosplat.viewer.front_end import Viewer
from thermosplat.viewer.notices import AT_ONCE, NOTICES, SECONDS

HOSTILE: list[Any] = [
    *(None, True, False, "", "x", "x" * 5000, "\0", "\x1b[31m", "\u202e", "../../x", "a/" * 3000, b"", b"\xff" * 100),
    *(0, -1, 1, 16, 2**31, 2**63, -(2**63), 2**64 - 1, 0.5, 1e30, -1e30, 1e300, 1e-300, 5e-324, -0.0),
    *(float("nan"), float("inf"), -float("inf"), [], {}, [[]], [1, 2, 3], {"a": 1}, [[0.0] * 4] * 4, ["x"] * 1000),
    *("GuiUpdateMessage", "FileTransferPart", {"value": 1}, {"removed": True}, "shift", "click", "rect-select"),
]
OTHERS: list[dict[str, Any]] = [
    {"type": "FileTransferStartUpload", "source_component_uuid": "a", "transfer_uuid": "t", "filename": "x",
     "mime_type": "", "part_count": 10**9, "size_bytes": 2**62},
    {"type": "FileTransferPart", "source_component_uuid": "a", "transfer_uuid": "t", "part_index": 0, "content": b"x"},
    {"type": "GuiFormSubmitMessage", "uuid": "a"},
    {"type": "CommandTriggerMessage", "uuid": "a"},
    {"type": "ShareUrlRequest"},
    {"type": "LocalStorageGetItemResponseMessage", "request_uuid": "a", "value": "x", "error": None},
    {"type": "SceneNodeClickMessage", "name": "/frames/00000", "instance_index": None, "ray_origin": [0, 0, 0],
     "ray_direction": [0, 0, 1], "screen_pos": [0.5, 0.5], "modifier": None, "owner": ""},
]  # fmt: skip
HEADERS = [
    *("Host: localhost", "Host: [::1", "Host: evil.com@localhost", "Host: \u00e9", "Origin: http://[", "Origin: null"),
    *("Upgrade: websocket", "Upgrade: h2c", "Connection: Upgrade", "Sec-WebSocket-Version: 13", "Cookie: a", ": "),
    *("Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol: viser-v1", "Content-Length: 9"),
    *("Transfer-Encoding: chunked", "Accept-Encoding: gzip", "X: " + "y" * 9000, "no header"),
]
PATHS = [
    "/",
    "//",
    "/\u00e9/",
    "/%2e%2e/x",
    "/view/probe?key=a&x=nan&y=1e999",
    "/view/wipe?share=",
    "*",
    "http://[",
    "/\0",
]


FEW = 60


class Fuzz:
    """A viewer with a page, and what it says on the terminal meanwhile.

    Args:
        folder: For what visitors save.
    """

    def __init__(self, folder: Path) -> None:
        self.viewer = Viewer(viewed_toy(), folder / "measurements", port=0)
        self.page, self.cases = self.open(), 0
        self.labels = [handle.label for handle in self.page.visitor.client.gui._gui_input_handle_from_uuid.values()]

    def open(self) -> PageClient:
        """A page that is seen."""
        return PageClient(self.viewer, image_width=32, image_height=24)

    def __call__(self, rng: np.random.Generator) -> str:
        """One case."""
        self.cases += 1
        NOTICES.clock = partial(time_later, AT_ONCE * SECONDS * self.cases)  # each case may say as much as the first
        said, sys.stderr = sys.stderr, io.StringIO()
        try:
            kind = self.request(rng) if rng.integers(0, 4) == 0 else self.message(rng)
            self.check()
        finally:
            said, sys.stderr = sys.stderr, said
        assert isinstance(said, io.StringIO)
        lines = said.getvalue().splitlines()
        assert not [line for line in lines if not line.startswith(("Viewer: ", "Warp "))], lines
        assert not [line for line in lines if "could not be" in line or "asked for failed" in line], lines
        return kind

    def message(self, rng: np.random.Generator) -> str:
        """A message that is changed in a value or in its bytes, or large, or none."""
        message = self.usual(rng)
        how = rng.integers(0, 10)
        if how < 6:
            message = replaced(message, rng)
        content = msgspec.msgpack.encode(message)
        if how in (6, 7):
            content = changed_bytes(content, rng)
        elif how == 8:
            content += rng.bytes(int(rng.choice(np.array(EXTREMES, dtype=object)) % 200_000))
        self.page.socket.send(content.decode("latin-1") if how == 9 else content)
        return "message"

    def usual(self, rng: np.random.Generator) -> dict[str, Any]:
        """Something that a page says, of a kind that is looked at or of one that never is."""
        kind = rng.integers(0, 8)
        if kind == 0:
            return {**CAMERA, "position": rng.normal(size=3).tolist()}
        if kind == 1:
            return OTHERS[rng.integers(0, len(OTHERS))]
        if kind == 2:
            places = rng.uniform(size=(int(rng.integers(1, 3)), 2)).tolist()
            event, ray = ("click", [0.0, 0.0, 1.0]) if len(places) == 1 else ("rect-select", None)
            return {"type": "ScenePointerMessage", "event_type": event, "ray_origin": ray, "ray_direction": ray,
                    "screen_pos": places, "modifier": None}  # fmt: skip
        control = self.page.control(self.labels[rng.integers(0, len(self.labels))])
        options = getattr(control, "options", None)
        value = control.value if options is None else options[rng.integers(0, len(options))]
        if isinstance(value, int | float) and not isinstance(value, bool):
            value = float(rng.choice([0.0, 1.0, -1.0, 1e8, 1e-8, 30.0])) * rng.normal()
        if kind == 3:
            value = HOSTILE[rng.integers(0, len(HOSTILE))]
        return {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {"value": value}}

    def request(self, rng: np.random.Generator) -> str:
        """A request of strange parts, or one with changed bytes."""
        chosen = [HEADERS[index] for index in rng.integers(0, len(HEADERS), int(rng.integers(0, 7)))]
        path = PATHS[rng.integers(0, len(PATHS))] if rng.integers(0, 2) else "/view/probe"
        method = str(rng.choice(["GET", "GET", "GET", "POST", "HEAD", "get", "G\0T", ""]))
        content = "\r\n".join([f"{method} {path} HTTP/1.1", *chosen, "", ""]).encode()
        if rng.integers(0, 2):
            content = changed_bytes(content, rng)
        with socket.create_connection(("127.0.0.1", self.viewer.server.get_port()), timeout=60) as connection:
            answer = b""
            try:
                connection.sendall(content)
                connection.shutdown(socket.SHUT_WR)
                while part := connection.recv(1 << 16):
                    answer += part
            except ConnectionError:
                pass
        assert not answer.startswith(b"HTTP/1.1 5"), answer[:200]
        return "request"

    def check(self) -> None:
        """The page is heard, its inputs have values that they may have, and little is at work."""
        if not self.page.is_heard():  # a message was too large
            self.page = self.open()
        for control in self.page.visitor.client.gui._gui_input_handle_from_uuid.values():
            value = control.value
            if getattr(control, "options", None) is not None:
                assert value in control.options
            elif isinstance(value, int | float):
                assert np.isfinite(value)
                assert abs(value) <= 1e9
            else:
                assert len(value) <= 200
        assert np.isfinite(self.page.visitor.view().viewmat).all()
        assert threading.active_count() < 80


def time_later(seconds: float) -> float:
    """A clock that is ahead [s]."""
    return time.monotonic() + seconds


def replaced(value: Any, rng: np.random.Generator) -> Any:
    """The same tree with something else in one place, or without it."""
    if isinstance(value, dict | list) and value and rng.integers(0, 8):
        copied = value.copy()
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        key = keys[rng.integers(0, len(keys))]
        if rng.integers(0, 8) == 0:
            del copied[key]
        else:
            copied[key] = replaced(value[key], rng)
        return copied
    hostile = HOSTILE[rng.integers(0, len(HOSTILE))]
    for _ in range(int(rng.choice([0] * 20 + [5, 900]))):
        hostile = [hostile]
    return hostile


def make(folder: Path) -> Fuzzer:
    """Small pictures, at once."""
    picture_sizes.MOST_PIXELS, visitor.START_SECONDS = 1 << 12, 0.0
    return Fuzz(folder)


@pytest.mark.rotating("fuzzed input")
def test_strange_pages_and_requests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A few of them here, and as many as the environment asks for apart."""
    if number_of_cases(FEW) != FEW:
        run_apart(__file__, number_of_cases(FEW))
        return
    monkeypatch.setattr(picture_sizes, "MOST_PIXELS", 1 << 12)
    monkeypatch.setattr(visitor, "START_SECONDS", 0.0)
    fuzz = Fuzz(tmp_path)
    try:
        for number in range(FEW):
            fuzz(np.random.default_rng(number))
    finally:
        fuzz.viewer.stop()


@pytest.mark.slow
def test_thousands_of_strange_pages_and_requests() -> None:
    """In a process of their own, each in bounded time and memory."""
    run_apart(__file__, 2000)


if __name__ == "__main__":
    main(make)
