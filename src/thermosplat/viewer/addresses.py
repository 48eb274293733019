"""Addresses: what a request may call this server, and where a server can be opened."""

import re
import socket
from collections.abc import Sequence
from ipaddress import ip_address
from typing import Any

from thermosplat.errors import UserError

_PORTS_TRIED = 1000
_LAST_PORT = 65_535
_HOST = r"(?:\[(?P<v6>[0-9A-Fa-f:.]{2,45})\]|(?P<name>[A-Za-z0-9_-][A-Za-z0-9._-]{0,252}))(?::(?P<port>[0-9]{1,5}))?"
_ORIGIN = re.compile(r"[a-z][a-z0-9+.-]{0,30}://" + _HOST)


def is_this_machine(host: str) -> bool:
    """Whether an address or name is one that only this machine answers to."""
    if host.lower() == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def host_of(header: str) -> str | None:
    """The name or address that a Host header asks for.

    Returns:
        It without port and brackets; None of a header that is no host as RFC 9110 has it.
    """
    return _host_in(re.fullmatch(_HOST, header))


def is_origin(header: str) -> bool:
    """Whether an Origin header says where a page comes from, or that it comes from nowhere."""
    return header == "null" or _host_in(_ORIGIN.fullmatch(header.lower())) is not None


def _host_in(found: "re.Match[str] | None") -> str | None:
    if found is None or int(found["port"] or 0) > _LAST_PORT:
        return None
    if found["v6"] is None:
        return found["name"]
    try:
        ip_address(found["v6"])
    except ValueError:
        return None
    return found["v6"] if ":" in found["v6"] else None


def free_port(host: str, port: int) -> int:
    """The first port that is free at an address. viser would look for it at addresses of other machines, too, and
    behind the last port.

    Args:
        port: Where to begin, 0 to 65,535; 0: anywhere.

    Raises:
        UserError: The address is not one of this machine, or none of the ports is free.
    """
    hint = "Give --host an address of this machine, or leave it out."
    try:
        places = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM) if host else []
        if not places:
            raise OSError("it is empty")
        _bind(places, 0)
    except (OSError, ValueError) as error:  # ValueError: no name of a host at all
        why = getattr(error, "strerror", None) or str(error)
        raise UserError(f"Cannot serve at the address {host}: {why}.", hint) from error
    last = min(port + _PORTS_TRIED - 1, _LAST_PORT) if port else 0
    for tried in range(port, last + 1):
        try:
            _bind(places, tried)
        except OSError:
            continue
        return tried
    raise UserError(f"None of the ports {port} to {last} is free at {host}.", "Give the viewer a lower port.")


def _bind(places: Sequence[tuple[Any, Any, int, str, tuple[Any, ...]]], port: int) -> None:
    """Try whether a server could be opened at places, all of them, as asyncio opens it."""
    for family, kind, protocol, _, at in places:
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            probe.bind((at[0], port, *at[2:]))
