"""A sealed letter: encrypted with a key that is kept elsewhere, known by its hash before anybody can read it."""

import hashlib
import os
import stat
from pathlib import Path

from cryptography.fernet import Fernet, InvalidToken

from fleet.process import private_files


def digest(*paths: Path) -> str:
    """Return the SHA-256 of files, one after the other."""
    told = hashlib.sha256()
    for path in paths:
        told.update(path.read_bytes())
    return told.hexdigest()


def seal(words: bytes, sealed: Path, key: Path) -> None:
    """Encrypt into `sealed`, and put the key where only its owner reads it."""
    secret = Fernet.generate_key()
    private_files.write(key, secret)
    sealed.write_bytes(Fernet(secret).encrypt(words))


def taken(key: Path) -> bytes:
    """Read a key and remove its file, so that no process that begins later can read it.

    Raises:
        ValueError: when others could have read or changed it.
        OSError: when it cannot be read.
    """
    found = key.lstat()
    mode = stat.S_IMODE(found.st_mode)
    if not stat.S_ISREG(found.st_mode) or mode & 0o077 or found.st_uid != os.geteuid():
        raise ValueError(
            f"{key}: found mode {mode:04o}, owner {found.st_uid}, expected a file for its owner alone; start anew"
        )
    secret = key.read_bytes()
    key.unlink()
    return secret


def unseal(sealed: Path, key: bytes, promised: str) -> bytes:
    """Open a seal.

    Raises:
        ValueError: when the letter is not the one whose hash was promised, or the key does not fit.
    """
    if digest(sealed) != promised:
        raise ValueError(f"{sealed.name}: found another hash than {promised[:16]}…, expected the labels; start anew")
    try:
        return Fernet(key.strip()).decrypt(sealed.read_bytes())
    except (InvalidToken, ValueError):
        raise ValueError(f"{sealed.name}: found a key of another seal, expected its own; start anew") from None
