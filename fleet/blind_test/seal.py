"""Encryption of the labels: the key is stored apart, and the hash is published before decryption."""

import hashlib
import os
import stat
from pathlib import Path

from cryptography.fernet import Fernet, InvalidToken

from fleet.process import private_files


def digest(*paths: Path) -> str:
    """Return the SHA-256 of the concatenated files."""
    hasher = hashlib.sha256()
    for path in paths:
        hasher.update(path.read_bytes())
    return hasher.hexdigest()


def encrypt(data: bytes, sealed_path: Path, key: Path) -> None:
    """Encrypt data into a file and write the key to a file that only its owner can read."""
    key_bytes = Fernet.generate_key()
    private_files.write_secret(key, key_bytes)
    sealed_path.write_bytes(Fernet(key_bytes).encrypt(data))


def consume_key(key: Path) -> bytes:
    """Read a key and delete its file, so that no later process can read it.

    Raises:
        ValueError: when other users could have read or changed it.
        OSError: when it cannot be read.
    """
    status = key.lstat()
    mode = stat.S_IMODE(status.st_mode)
    if not stat.S_ISREG(status.st_mode) or mode & 0o077 or status.st_uid != os.geteuid():
        raise ValueError(
            f"{key}: found mode {mode:04o}, owner {status.st_uid}, expected a file for its owner only; restart the test"
        )
    key_bytes = key.read_bytes()
    key.unlink()
    return key_bytes


def decrypt(sealed_path: Path, key: bytes, expected_hash: str) -> bytes:
    """Decrypt a file.

    Raises:
        ValueError: when the file does not have the committed hash, or the key does not match.
    """
    if digest(sealed_path) != expected_hash:
        raise ValueError(
            f"{sealed_path.name}: found another hash than {expected_hash[:16]}…, expected the labels; restart the test"
        )
    try:
        return Fernet(key.strip()).decrypt(sealed_path.read_bytes())
    except (InvalidToken, ValueError):
        raise ValueError(f"{sealed_path.name}: found a wrong key, expected its own; restart the test") from None
