"""Ports of this machine: who uses them. Linux only; elsewhere no program is named."""

import contextlib
import re
import socket
from collections.abc import Collection, Iterator
from pathlib import Path

from fleet.health.machine import MAVLINK_PORT, NOTE, OK, CheckResult, is_port_free
from fleet.process.sanitise import printable

VIEWER_PORT = 8080  # default port of the viewer

_TABLES = {socket.SOCK_STREAM: ("tcp", "tcp6"), socket.SOCK_DGRAM: ("udp", "udp6")}
_LISTEN = "0A"  # state of a listening TCP socket. Source: Linux, include/net/tcp_states.h


def port_user(kind: socket.SocketKind, port: int, proc: Path = Path("/proc")) -> str:
    """Name the program that listens on a local port, e.g. `chromium, process 4711`; empty where it is not visible."""
    inodes = set(_inodes(kind, port, proc))
    if not inodes:
        return ""
    for folder in proc.glob("[0-9]*"):
        if any(f"socket:[{inode}]" in set(_open_files(folder)) for inode in inodes):
            return f"{printable(_program(folder))}, process {folder.name}"
    return ""


def _inodes(kind: socket.SocketKind, port: int, proc: Path) -> Iterator[str]:
    for name in _TABLES[kind]:
        try:
            lines = (proc / "net" / name).read_text().splitlines()[1:]
        except OSError:
            continue
        for fields in map(str.split, lines):
            listens = kind == socket.SOCK_DGRAM or fields[3] == _LISTEN
            if listens and int(fields[1].rpartition(":")[2], 16) == port:
                yield fields[9]


def _open_files(folder: Path) -> Iterator[str]:
    """Yield the names of the open files of a process; nothing for a process of another user."""
    with contextlib.suppress(OSError):
        for link in (folder / "fd").iterdir():
            with contextlib.suppress(OSError):  # closed meanwhile
                yield link.readlink().name


def _program(folder: Path) -> str:
    """Return the name of a process: the module or script of a Python program, else the executable."""
    try:
        words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
        name = (folder / "comm").read_text().strip()
    except OSError:
        return "a program"
    if re.match(r"python", Path(words[0]).name) and len(words) > 1:
        scripts = (word for word in words[1:] if not word.startswith("-"))
        after = words[words.index("-m") + 1] if "-m" in words[:-1] else "" if "-c" in words else next(scripts, "")
        return Path(after).name.removesuffix(".cli") or name
    return name


def mavlink_port(links: Collection[str] = ()) -> CheckResult:
    """Check that the default MAVLink UDP port is free; `links` are open links of local gateways."""
    if any(f":{MAVLINK_PORT}" in link for link in links):
        return CheckResult(OK, "mavlink", f"udp port {MAVLINK_PORT} is used by the gateway")
    if is_port_free(socket.SOCK_DGRAM, "0.0.0.0", MAVLINK_PORT):
        return CheckResult(OK, "mavlink", f"udp port {MAVLINK_PORT} is free")
    user = _by(port_user(socket.SOCK_DGRAM, MAVLINK_PORT))
    remedy = "correct for a gateway container, else use another: --link udpin:0.0.0.0:14551"
    return CheckResult(NOTE, "mavlink", f"udp port {MAVLINK_PORT} is in use{user}; {remedy}")


def viewer_port(port: int = VIEWER_PORT) -> CheckResult:
    """Check that the default port of the viewer is free or used by a viewer."""
    if is_port_free(socket.SOCK_STREAM, "127.0.0.1", port):
        return CheckResult(OK, "viewer", f"tcp port {port} is free")
    user = port_user(socket.SOCK_STREAM, port)
    if user.startswith("viewer,"):
        return CheckResult(OK, "viewer", f"tcp port {port} is used by {user}")
    return CheckResult(NOTE, "viewer", f"tcp port {port} is in use{_by(user)}; choose another: --port {port + 1}")


def _by(user: str) -> str:
    return f" by {user}" if user else ""
