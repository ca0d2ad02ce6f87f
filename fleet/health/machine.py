"""Checks of this machine: Python, packages, caches, ports, browser."""

import importlib.metadata
import os
import shutil
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import fleet
from fleet.process import private_files

OK, NOTE, BAD = "ok", "note", "BAD"


class CheckResult(NamedTuple):
    """Grade `ok`, `note` (optional part missing, or future problem) or `BAD` (the fleet cannot run correctly)."""

    grade: str
    what: str
    sentence: str


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
MAVLINK_PORT = 14550


def check_machine() -> Iterator[CheckResult]:
    """Run all checks of the machine."""
    yield python()
    yield from packages()
    yield compile_cache()
    yield from onboard_cache()
    yield from (chromium(), recordings())


def python() -> CheckResult:
    """Report the Python version; one older than 3.11 cannot import this module."""
    return CheckResult(OK, "python", ".".join(map(str, sys.version_info[:3])))


def packages() -> Iterator[CheckResult]:
    """Check that every run-time dependency is installed."""
    try:
        requirements = importlib.metadata.requires("parauav") or []
    except importlib.metadata.PackageNotFoundError:
        yield CheckResult(NOTE, "packages", "parauav is on the path but not installed; run make setup")
        return
    names = [line.split(";")[0].strip() for line in requirements if "extra ==" not in line]
    missing = [name for name in names if not _installed(name)]
    if missing:
        yield CheckResult(BAD, "packages", f"missing {', '.join(missing)}; run make setup")
    else:
        yield CheckResult(OK, "packages", ", ".join(f"{name} {_installed(name)}" for name in names))


def _installed(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


def compile_cache() -> CheckResult:
    """Check that the numba cache is writable, and by this user only."""
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    try:
        problem, foreign_files = private_files.tampering_risk(folder), private_files.foreign_files(folder)
    except OSError as error:
        return CheckResult(BAD, "compile cache", f"{error}; set another folder in PARAUAV_CACHE")
    if problem:
        return CheckResult(BAD, "compile cache", f"{folder}: found {problem}")
    if foreign_files:
        risk = f"they could execute code as this user; rm -r {folder}"
        return CheckResult(BAD, "compile cache", f"{folder}: found {len(foreign_files)} files of other users; {risk}")
    if not os.access(folder, os.W_OK):
        return CheckResult(BAD, "compile cache", f"{folder} is not writable; set another folder in PARAUAV_CACHE")
    if fleet.CACHE_NOTE:
        return CheckResult(NOTE, "compile cache", f"{folder}: {fleet.CACHE_NOTE}")
    count = sum(1 for _ in folder.rglob("*.nbc"))
    state = f"{count} functions compiled" if count else "empty, so the first start compiles (a minute)"
    return CheckResult(OK, "compile cache", f"{folder}: {state}")


def onboard_cache() -> Iterator[CheckResult]:
    """Check the folder of cached parameters and missions, when there is one."""
    try:
        folder = private_files.onboard_folder()
        problem = private_files.tampering_risk(folder)
    except (OSError, RuntimeError):
        return
    if problem:
        yield CheckResult(BAD, "onboard cache", f"{folder}: found {problem}")
    else:
        yield CheckResult(OK, "onboard cache", f"{folder}: {sum(1 for _ in folder.glob('*.json'))} aircraft")


def is_port_free(kind: socket.SocketKind, host: str, port: int) -> bool:
    """Return whether a local port is free."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, kind) as probe:
            if kind == socket.SOCK_STREAM:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            return True
    except OSError:
        return False


def chromium() -> CheckResult:
    """Check for a browser, needed by viewer tests and screenshots only."""
    path = os.environ.get("PARAUAV_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        remedy = "apt-get install chromium, or set PARAUAV_CHROMIUM"
        return CheckResult(NOTE, "chromium", f"not found, no browser tests; {remedy}")
    return CheckResult(OK, "chromium", path)


def recordings() -> CheckResult:
    """Check for recorded flights, needed by some tests only."""
    folder = os.environ.get("PARAUAV_RECORDINGS")
    if not folder or not Path(folder).is_dir():
        text = f"PARAUAV_RECORDINGS is {folder or 'not set'}; tests on recordings are skipped"
        return CheckResult(NOTE, "recordings", text)
    count = sum(1 for path in Path(folder).rglob("*") if path.is_file())
    return CheckResult(OK, "recordings", f"{count} files in {folder}")
