"""Folders and files that only their owner may change: checked before anything in them is believed or run."""

import os
import stat
from pathlib import Path

_WRITABLE = stat.S_IWGRP | stat.S_IWOTH


def trouble(path: Path) -> str:
    """Say why another local user could have changed what is at a path, or can; empty: nobody can.

    The path itself must be ours; each folder above it ours or root's, and writable by others only where it is sticky.

    Raises:
        OSError: when it cannot be looked at.
    """
    real = path.resolve(strict=True)
    found = real.stat()
    if found.st_uid != os.geteuid():
        return f"owner {found.st_uid}, expected {os.geteuid()}, who runs this; name one of your own"
    if found.st_mode & _WRITABLE:
        return f"mode {stat.S_IMODE(found.st_mode):04o}, expected none but its owner to write there; chmod go-w {real}"
    for above in real.parents:
        found = above.stat()
        mode = stat.S_IMODE(found.st_mode)
        if found.st_uid not in (0, os.geteuid()):
            return f"{above} above it with owner {found.st_uid}, expected root or {os.geteuid()}; name another folder"
        if mode & _WRITABLE and not mode & stat.S_ISVTX:
            return f"{above} above it with mode {mode:04o}, expected that only its owner may write; chmod go-w {above}"
    return ""


def cache_folder() -> Path:
    """Name this user's cache folder of ParaUAV.

    Raises:
        RuntimeError: when the user has no home.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    found = Path(base) if os.path.isabs(base) else Path.home() / ".cache"
    if not found.is_absolute():
        raise RuntimeError(f"found HOME {str(found.parent)!r}, expected a whole path")
    return found / "parauav"


def onboard_folder() -> Path:
    """Name the folder of what aircraft told before: in this user's cache, or what PARAUAV_ONBOARD says.

    Raises:
        RuntimeError: when the user has no home.
    """
    given = os.environ.get("PARAUAV_ONBOARD")
    return Path(given).absolute() if given else cache_folder() / "onboard"


def folder(path: Path, what: str) -> Path:
    """Make a folder for its owner alone, or accept the one there.

    Args:
        path: of the folder
        what: it is for, in sentences
    Raises:
        ValueError: when others could have put something there, or can.
        OSError: when it cannot be made or looked at.
    """
    missing = [one for one in (path, *path.parents) if not one.exists()]
    for one in reversed(missing):
        one.mkdir(mode=0o700, exist_ok=True)
    if found := trouble(path):
        raise ValueError(f"{what} {path}: found {found}")
    return path


def close(path: Path) -> None:
    """Let nobody but its owner look into a folder of ours.

    Raises:
        OSError: when it cannot be done.
    """
    if stat.S_IMODE(path.stat().st_mode) & 0o077:
        path.chmod(0o700)


def strangers(path: Path) -> list[Path]:
    """Return what a folder holds that belongs to another user; root's is believed."""
    owners = (0, os.geteuid())
    return [one for one in sorted(path.rglob("*")) if one.lstat().st_uid not in owners]


def write(path: Path, data: bytes) -> None:
    """Write a secret into a new file that only its owner may read, in place of what is there.

    Raises:
        OSError: when it cannot be written.
    """
    fresh = path.with_name(f".{path.name}.{os.getpid()}.new")
    fresh.unlink(missing_ok=True)
    try:
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600), "wb") as file:
            file.write(data)
        fresh.replace(path)
    except OSError:
        fresh.unlink(missing_ok=True)
        raise
