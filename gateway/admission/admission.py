"""What one link lets in: only frames its sieve wants, and none whose signature speaks against it."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from fleet.telemetry.mavlink.parsing.decode import Frames
from gateway.admission.signing import Signing, pick, read_keys
from gateway.settings.link_spec import Spec
from gateway.settings.message_filter import Sieve

SIEVED = "left out, as the link says"


class Gate:
    """The gate of one link.

    Args:
        sieve: which frames it wants
        signing: its signatures; None: they are not looked at
    """

    def __init__(self, sieve: Sieve, signing: Signing | None = None) -> None:
        self._sieve, self._signing = sieve, signing

    def admit(self, frames: Frames, refused: Counter[str]) -> Frames:
        """Return the frames that may come in, and count the others by reason."""
        if self._signing is not None and len(frames.at):
            frames = frames.only(self._signing.passes(frames, refused))
        if self._sieve.rules and len(frames.at):
            kept = self._sieve.keep(frames.at)
            refused[SIEVED] += int((~kept).sum())
            frames = frames.only(kept)
        return frames

    def sign(self, message: bytes) -> bytes:
        """Return a message of ours as it goes out."""
        return message if self._signing is None else self._signing.sign(message)


def gates_of(specs: Sequence[Spec], stations: int = 0, keys: Path | None = None) -> list[Gate]:
    """Make the gates of all links; the sieve of a station's link is for what is sent there, not for what it says.

    Args:
        specs: the links
        stations: how many of the last ones lead to ground stations
        keys: file of keys
    Raises:
        ValueError: when the file of keys is not safe, or lacks the key of a link.
        OSError: when it cannot be read.
    """
    known = read_keys(keys) if keys is not None else {}
    found = []
    for number, spec in enumerate(specs):
        signing = Signing(pick(known, spec.key, spec.text), spec.sign == "require", number) if spec.sign else None
        found.append(Gate(spec.sieve if number < len(specs) - stations else Sieve(), signing))
    return found
