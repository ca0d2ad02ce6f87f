"""Encryption of the labels: the key is stored apart, and the hash is published before decryption."""

import hashlib
import os
import stat
from pathlib import Path

from cryptography.fernet import Fernet, InvalidToken

from fleet.process import private_files


def digest(*paths: Path) -> str:
    """Return the SHA-256 of the concatenated files."""
    told = hashlib.sha256()
    for path in paths:
        told.update(path.read_bytes())
    return told.hexdigest()


def seal(words: bytes, sealed: Path, key: Path) -> None:
    """Encrypt data into a file and write the key to a file that only its owner can read."""
    secret = Fernet.generate_key()
    private_files.write(key, secret)
    sealed.write_bytes(Fernet(secret).encrypt(words))


def taken(key: Path) -> bytes:
    """Read a key and delete its file, so that no later process can read it.

    Raises:
        ValueError: when other users could have read or changed it.
        OSError: when it cannot be read.
    """
    found = key.lstat()
    mode = stat.S_IMODE(found.st_mode)
    if not stat.S_ISREG(found.st_mode) or mode & 0o077 or found.st_uid != os.geteuid():
        raise ValueError(
            f"{key}: found mode {mode:04o}, owner {found.st_uid}, expected a file for its owner only; restart the test"
        )
    secret = key.read_bytes()
    key.unlink()
    return secret


def unseal(sealed: Path, key: bytes, promised: str) -> bytes:
    """Decrypt a file.

    Raises:
        ValueError: when the file does not have the committed hash, or the key does not match.
    """
    if digest(sealed) != promised:
        raise ValueError(
            f"{sealed.name}: found another hash than {promised[:16]}…, expected the labels; restart the test"
        )
    try:
        return Fernet(key.strip()).decrypt(sealed.read_bytes())
    except (InvalidToken, ValueError):
        raise ValueError(f"{sealed.name}: found a wrong key, expected its own; restart the test") from None
