"""A connection between ranks that breaks when one of them dies, so that no other waits for it.

A rank that waits in a collective call hears nothing: NCCL waits on, and Python handles no signals meanwhile. So every
rank holds a TCP connection to rank 0, which the system closes when a process ends, however it ends, and a thread at
either end of it ends the process as soon as another rank has ended without saying that it is done. One rank tells the
user: the one that failed, or, of one that was killed, rank 0; of rank 0, rank 1.
"""

import hmac
import json
import os
import secrets
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, Queue
from typing import Any, NoReturn

from thermosplat.distributed.team import Team

DIED = 2
"""Exit code of the ranks after one that was killed."""
_CONNECTING = 60.0
"""Time to connect [s]."""
_ANSWERING = 20.0
"""Time for an answer of rank 0 [s], which may have to write a file to its end."""
_PROBING = ((socket.TCP_KEEPIDLE, 5), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))
"""A host that is gone without a word is noticed after 20 seconds."""


class Lifeline:
    """This rank's end of the connections.

    Args:
        tell: Tells the user that a rank died: its name. Called on one rank alone.

    Attributes:
        before_end: Called before the process is ended for another one's sake, for what must not be cut off.
        answer: On rank 0: what another rank hears that asks, in a thread, while the training waits.
    """

    def __init__(self, team: Team, tell: Callable[[str], object]) -> None:
        self.team = team
        self.before_end: Callable[[], object] = lambda: None
        self.answer: Callable[[], str] = lambda: ""
        self._heard: Queue[str] = Queue()
        self._tell = tell
        self._ended = threading.Lock()
        self._done: set[int] = set()
        self._peers: dict[int, socket.socket] = {}
        self._names = [str(name) for name in team.objects(f"process {os.getpid()} on {socket.gethostname()}")]
        if team.is_first:
            self._listen()
        else:
            self._connect()
        for rank, peer in self._peers.items():
            threading.Thread(target=self._watch, args=(rank, peer), daemon=True).start()

    def failed(self, code: int) -> None:
        """Tell the other ranks that this one ends with a code, and has said why."""
        self._done.update(range(self.team.size))  # their ends are no news any more
        self._send_all({"ended": code})

    def asked_of_first(self) -> str | None:
        """What rank 0 answers, in whatever it waits; None where it does not."""
        if self.team.is_first:
            return self.answer()
        try:
            self._peers[0].sendall(_message({"asks": True}))
            return self._heard.get(timeout=_ANSWERING)
        except (OSError, Empty):
            return None

    def done(self) -> None:
        """Tell the other ranks that this one has come to its end."""
        self._send_all({"done": True})

    def _listen(self) -> None:
        server = socket.create_server(("", 0), backlog=self.team.size)
        token = secrets.token_hex(16)
        self.team.object_of_first((server.getsockname()[1], token))
        server.settimeout(_CONNECTING)
        while len(self._peers) < self.team.size - 1:
            peer, _ = server.accept()
            peer.settimeout(_CONNECTING)
            said = json.loads(_line(peer) or "{}")
            if isinstance(said, dict) and hmac.compare_digest(str(said.get("token")), token):
                self._peers[int(said["rank"])] = _lasting(peer)
            else:
                peer.close()
        server.close()

    def _connect(self) -> None:
        port, token = self.team.object_of_first()
        host = os.environ.get("MASTER_ADDR", "127.0.0.1")
        peer = socket.create_connection((host, port), timeout=_CONNECTING)
        peer.sendall(_message({"token": token, "rank": self.team.rank}))
        self._peers[0] = _lasting(peer)

    def _watch(self, rank: int, peer: socket.socket) -> None:
        """Wait for a rank's words, or for its end."""
        while True:
            try:
                line = _line(peer)
            except OSError:
                line = ""
            said: dict[str, Any] = json.loads(line) if line else {}
            if said.get("done"):
                self._done.add(rank)
            elif said.get("asks"):
                text = ""
                with suppress(Exception):
                    text = self.answer()
                with suppress(OSError):
                    peer.sendall(_message({"answer": text}))
            elif "answer" in said:
                self._heard.put(str(said["answer"]))
            elif "ended" in said:
                self._end(int(said["ended"]))
            elif not line:
                if rank in self._done:
                    return
                self._end(DIED, rank)

    def _end(self, code: int, died: int | None = None) -> NoReturn:
        """End this process, and if it is rank 0 the others."""
        self._ended.acquire()  # and never let go: one thread ends the process
        if died == 0:
            self._peers[0].close()  # who asks it now hears nothing
        if died is not None and self.team.rank == (1 if died == 0 else 0):
            with suppress(Exception):
                self._tell(f"Rank {died} of {self.team.size} ({self._names[died]})")
        if self.team.is_first:
            self._send_all({"ended": code})
        with suppress(Exception):
            self.before_end()
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)

    def _send_all(self, message: dict[str, Any]) -> None:
        for peer in self._peers.values():
            with suppress(OSError):
                peer.sendall(_message(message))


def _message(content: dict[str, Any]) -> bytes:
    return (json.dumps(content) + "\n").encode()


def _lasting(peer: socket.socket) -> socket.socket:
    """A connection that waits for as long as both ends live."""
    peer.settimeout(None)
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _PROBING:
        peer.setsockopt(socket.IPPROTO_TCP, option, value)
    return peer


def _line(peer: socket.socket) -> str:
    """The next line; empty where the connection ended."""
    received = b""
    while not received.endswith(b"\n"):
        byte = peer.recv(1)
        if not byte:
            return ""
        received += byte
        if len(received) > 4096:
            return ""
    return received.decode(errors="replace")
