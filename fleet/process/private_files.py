"""Check that folders and files are writable by their owner only, before their content is read or executed."""

import os
import stat
from pathlib import Path

_WRITABLE = stat.S_IWGRP | stat.S_IWOTH


def tampering_risk(path: Path) -> str:
    """Return the reason for which another local user could change the content of a path; empty: none could.

    The current user must own the path. The current user or root must own each parent folder, and others may write to
    a parent only where it is sticky.

    Raises:
        OSError: when its status cannot be read.
    """
    real = path.resolve(strict=True)
    status = real.stat()
    if status.st_uid != os.geteuid():
        return f"owner {status.st_uid}, expected {os.geteuid()}, the current user; name a folder of your own"
    if status.st_mode & _WRITABLE:
        mode = stat.S_IMODE(status.st_mode)
        return f"mode {mode:04o}, expected write permission for its owner only; chmod go-w {real}"
    for parent in real.parents:
        status = parent.stat()
        mode = stat.S_IMODE(status.st_mode)
        if status.st_uid not in (0, os.geteuid()):
            return f"parent {parent} with owner {status.st_uid}, expected root or {os.geteuid()}; name another folder"
        if mode & _WRITABLE and not mode & stat.S_ISVTX:
            remedy = f"chmod go-w {parent}"
            return f"parent {parent} with mode {mode:04o}, expected write permission for its owner only; {remedy}"
    return ""


def cache_folder() -> Path:
    """Return this user's cache folder of ParaUAV.

    Raises:
        RuntimeError: when the user has no home.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    cache_root = Path(base) if os.path.isabs(base) else Path.home() / ".cache"
    if not cache_root.is_absolute():
        raise RuntimeError(f"found HOME {str(cache_root.parent)!r}, expected an absolute path")
    return cache_root / "parauav"


def state_folder() -> Path:
    """Return this user's folder of records that must outlast a restart.

    Raises:
        RuntimeError: when the user has no home.
    """
    base = os.environ.get("XDG_STATE_HOME", "")
    root = Path(base) if os.path.isabs(base) else Path.home() / ".local" / "state"
    if not root.is_absolute():
        raise RuntimeError(f"found HOME {str(root.parent.parent)!r}, expected an absolute path")
    return root / "parauav"


def onboard_folder() -> Path:
    """Return the folder of cached onboard data of aircraft: PARAUAV_ONBOARD, or a folder in this user's cache.

    Raises:
        RuntimeError: when the user has no home.
    """
    configured = os.environ.get("PARAUAV_ONBOARD")
    return Path(configured).absolute() if configured else cache_folder() / "onboard"


def ensure_private_folder(path: Path, label: str) -> Path:
    """Create a folder with access for its owner only, or check the existing one.

    Args:
        path: of the folder
        label: its purpose, for error messages
    Raises:
        ValueError: when another user can write to it.
        OSError: when it cannot be created or its status cannot be read.
    """
    missing = [parent for parent in (path, *path.parents) if not parent.exists()]
    for parent in reversed(missing):
        parent.mkdir(mode=0o700, exist_ok=True)
    if risk := tampering_risk(path):
        raise ValueError(f"{label} {path}: found {risk}")
    return path


def restrict_to_owner(path: Path) -> None:
    """Remove the permissions of group and others from a folder.

    Raises:
        OSError: when the mode cannot be changed.
    """
    if stat.S_IMODE(path.stat().st_mode) & 0o077:
        path.chmod(0o700)


def foreign_files(path: Path) -> list[Path]:
    """Return the content of a folder that belongs to a user other than the current one and root."""
    owners = (0, os.geteuid())
    return [child for child in sorted(path.rglob("*")) if child.lstat().st_uid not in owners]


def write_secret(path: Path, data: bytes) -> None:
    """Write a secret atomically to a file readable by its owner only.

    Raises:
        OSError: when it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.new")
    temporary.unlink(missing_ok=True)
    try:
        with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600), "wb") as file:
            file.write(data)
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
