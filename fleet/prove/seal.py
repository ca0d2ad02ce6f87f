"""A sealed letter: encrypted with a key that is kept elsewhere, known by its hash before anybody can read it."""

import hashlib
from pathlib import Path

from cryptography.fernet import Fernet, InvalidToken


def digest(*paths: Path) -> str:
    """Give the SHA-256 of files, one after the other."""
    told = hashlib.sha256()
    for path in paths:
        told.update(path.read_bytes())
    return told.hexdigest()


def seal(words: bytes, sealed: Path, key: Path) -> None:
    """Encrypt into `sealed`, and put the key where only its owner reads it."""
    secret = Fernet.generate_key()
    key.touch(mode=0o600)
    key.write_bytes(secret)
    sealed.write_bytes(Fernet(secret).encrypt(words))


def unseal(sealed: Path, key: Path, promised: str) -> bytes:
    """Open a seal.

    Raises:
        ValueError: when the letter is not the one whose hash was promised, or the key does not fit.
    """
    if digest(sealed) != promised:
        raise ValueError(f"{sealed.name}: found another hash than {promised[:16]}…, expected the labels; start anew")
    try:
        return Fernet(key.read_bytes().strip()).decrypt(sealed.read_bytes())
    except (InvalidToken, ValueError):
        raise ValueError(f"{key.name}: found no key of {sealed.name}, expected its own; name it") from None
