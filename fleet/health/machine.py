"""Checks of this machine: Python, packages, caches, ports, browser."""

import importlib.metadata
import os
import shutil
import socket
import sys
from collections.abc import Collection, Iterator
from pathlib import Path

import fleet
from fleet.health.finding import Finding
from fleet.process import private_files

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
MAVLINK_PORT = 14550


def look() -> Iterator[Finding]:
    """Run all checks of the machine."""
    yield python()
    yield from packages()
    yield compile_cache()
    yield from onboard_cache()
    yield from (chromium(), recordings())


def python() -> Finding:
    """Report the Python version; one older than 3.11 cannot import this module."""
    return Finding("ok", "python", ".".join(map(str, sys.version_info[:3])))


def packages() -> Iterator[Finding]:
    """Check that every run-time dependency is installed."""
    try:
        wanted = importlib.metadata.requires("parauav") or []
    except importlib.metadata.PackageNotFoundError:
        yield Finding("note", "packages", "parauav is on the path but not installed; run make setup")
        return
    names = [line.split(";")[0].strip() for line in wanted if "extra ==" not in line]
    missing = [name for name in names if not _installed(name)]
    if missing:
        yield Finding("BAD", "packages", f"missing {', '.join(missing)}; run make setup")
    else:
        yield Finding("ok", "packages", ", ".join(f"{name} {_installed(name)}" for name in names))


def _installed(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


def compile_cache() -> Finding:
    """Check that the numba cache is writable, and by this user only."""
    place = Path(os.environ["NUMBA_CACHE_DIR"])
    try:
        found, foreign = private_files.trouble(place), private_files.strangers(place)
    except OSError as error:
        return Finding("BAD", "compile cache", f"{error}; set another folder in PARAUAV_CACHE")
    if found:
        return Finding("BAD", "compile cache", f"{place}: found {found}")
    if foreign:
        cure = f"they could execute code as this user; rm -r {place}"
        return Finding("BAD", "compile cache", f"{place}: found {len(foreign)} files of other users; {cure}")
    if not os.access(place, os.W_OK):
        return Finding("BAD", "compile cache", f"{place} is not writable; set another folder in PARAUAV_CACHE")
    if fleet.CACHE_NOTE:
        return Finding("note", "compile cache", f"{place}: {fleet.CACHE_NOTE}")
    count = sum(1 for _ in place.rglob("*.nbc"))
    state = f"{count} functions compiled" if count else "empty, so the first start compiles (a minute)"
    return Finding("ok", "compile cache", f"{place}: {state}")


def onboard_cache() -> Iterator[Finding]:
    """Check the folder of cached parameters and missions, when there is one."""
    try:
        place = private_files.onboard_folder()
        found = private_files.trouble(place)
    except (OSError, RuntimeError):
        return
    if found:
        yield Finding("BAD", "onboard cache", f"{place}: found {found}")
    else:
        yield Finding("ok", "onboard cache", f"{place}: {sum(1 for _ in place.glob('*.json'))} aircraft")


def mavlink_port(links: Collection[str] = ()) -> Finding:
    """Check that the default MAVLink UDP port is free; `links` are open links of local gateways."""
    if any(f":{MAVLINK_PORT}" in link for link in links):
        return Finding("ok", "mavlink", f"udp port {MAVLINK_PORT} is used by the gateway")
    if free(socket.SOCK_DGRAM, "0.0.0.0", MAVLINK_PORT):
        return Finding("ok", "mavlink", f"udp port {MAVLINK_PORT} is free")
    cure = "correct for a gateway container, else use another: --link udpin:0.0.0.0:14551"
    return Finding("note", "mavlink", f"udp port {MAVLINK_PORT} is in use; {cure}")


def free(kind: socket.SocketKind, host: str, port: int) -> bool:
    """Return whether a local port is free."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, kind) as s:
            if kind == socket.SOCK_STREAM:
                s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            s.bind((host, port))
            return True
    except OSError:
        return False


def chromium() -> Finding:
    """Check for a browser, needed by viewer tests and screenshots only."""
    found = os.environ.get("PARAUAV_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        return Finding(
            "note",
            "chromium",
            "not found, no browser tests; apt-get install chromium, or set PARAUAV_CHROMIUM",
        )
    return Finding("ok", "chromium", found)


def recordings() -> Finding:
    """Check for recorded flights, needed by some tests only."""
    named = os.environ.get("PARAUAV_RECORDINGS")
    if not named or not Path(named).is_dir():
        return Finding(
            "note", "recordings", f"PARAUAV_RECORDINGS is {named or 'not set'}; tests on recordings are skipped"
        )
    count = sum(1 for path in Path(named).rglob("*") if path.is_file())
    return Finding("ok", "recordings", f"{count} files in {named}")
