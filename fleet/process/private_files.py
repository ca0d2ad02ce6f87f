"""Check that folders and files are writable by their owner only, before their content is read or executed."""

import os
import stat
from pathlib import Path

_WRITABLE = stat.S_IWGRP | stat.S_IWOTH


def trouble(path: Path) -> str:
    """Return the reason for which another local user could change the content of a path; empty: none could.

    The current user must own the path. The current user or root must own each parent folder, and others may write to
    a parent only where it is sticky.

    Raises:
        OSError: when its status cannot be read.
    """
    real = path.resolve(strict=True)
    found = real.stat()
    if found.st_uid != os.geteuid():
        return f"owner {found.st_uid}, expected {os.geteuid()}, the current user; name a folder of your own"
    if found.st_mode & _WRITABLE:
        return (
            f"mode {stat.S_IMODE(found.st_mode):04o}, expected write permission for its owner only; chmod go-w {real}"
        )
    for above in real.parents:
        found = above.stat()
        mode = stat.S_IMODE(found.st_mode)
        if found.st_uid not in (0, os.geteuid()):
            return f"parent {above} with owner {found.st_uid}, expected root or {os.geteuid()}; name another folder"
        if mode & _WRITABLE and not mode & stat.S_ISVTX:
            return (
                f"parent {above} with mode {mode:04o}, expected write permission for its owner only; chmod go-w {above}"
            )
    return ""


def cache_folder() -> Path:
    """Return this user's cache folder of ParaUAV.

    Raises:
        RuntimeError: when the user has no home.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    found = Path(base) if os.path.isabs(base) else Path.home() / ".cache"
    if not found.is_absolute():
        raise RuntimeError(f"found HOME {str(found.parent)!r}, expected an absolute path")
    return found / "parauav"


def onboard_folder() -> Path:
    """Return the folder of cached onboard data of aircraft: PARAUAV_ONBOARD, or a folder in this user's cache.

    Raises:
        RuntimeError: when the user has no home.
    """
    given = os.environ.get("PARAUAV_ONBOARD")
    return Path(given).absolute() if given else cache_folder() / "onboard"


def folder(path: Path, what: str) -> Path:
    """Create a folder with access for its owner only, or check the existing one.

    Args:
        path: of the folder
        label: its purpose, for error messages
    Raises:
        ValueError: when another user can write to it.
        OSError: when it cannot be created or its status cannot be read.
    """
    missing = [one for one in (path, *path.parents) if not one.exists()]
    for one in reversed(missing):
        one.mkdir(mode=0o700, exist_ok=True)
    if found := trouble(path):
        raise ValueError(f"{what} {path}: found {found}")
    return path


def close(path: Path) -> None:
    """Remove the permissions of group and others from a folder.

    Raises:
        OSError: when the mode cannot be changed.
    """
    if stat.S_IMODE(path.stat().st_mode) & 0o077:
        path.chmod(0o700)


def strangers(path: Path) -> list[Path]:
    """Return the content of a folder that belongs to a user other than the current one and root."""
    owners = (0, os.geteuid())
    return [one for one in sorted(path.rglob("*")) if one.lstat().st_uid not in owners]


def write(path: Path, data: bytes) -> None:
    """Write a secret atomically to a file readable by its owner only.

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
