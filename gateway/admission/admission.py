"""Admission of frames of one link: message filter and signature check."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from fleet.telemetry.mavlink.parsing.decode import Frames
from gateway.admission.signing import Signing, pick, read_keys
from gateway.settings.link_spec import Spec
from gateway.settings.message_filter import Sieve

SIEVED = "excluded by the filter of the link"


class Gate:
    """Admission of frames of one link.

    Args:
        message_filter: filter of frames
        signing: signature check; None: signatures are not checked
    """

    def __init__(self, sieve: Sieve, signing: Signing | None = None) -> None:
        self._sieve, self._signing = sieve, signing

    def admit(self, frames: Frames, refused: Counter[str]) -> Frames:
        """Return the accepted frames, and count the refused ones by reason."""
        if self._signing is not None and len(frames.at):
            frames = frames.only(self._signing.passes(frames, refused))
        if self._sieve.rules and len(frames.at):
            kept = self._sieve.keep(frames.at)
            refused[SIEVED] += int((~kept).sum())
            frames = frames.only(kept)
        return frames

    def sign(self, message: bytes) -> bytes:
        """Return an outgoing message, signed if the link requires it."""
        return message if self._signing is None else self._signing.sign(message)


def gates_of(specs: Sequence[Spec], stations: int = 0, keys: Path | None = None) -> list[Gate]:
    """Create the admission of each link; the filter of a station's link applies to frames sent there, not received.

    Args:
        specs: the links
        stations: number of links to ground stations, the last ones
        keys: file of keys
    Raises:
        ValueError: when the file of keys is readable by others, or lacks the key of a link.
        OSError: when it cannot be read.
    """
    known = read_keys(keys) if keys is not None else {}
    found = []
    for number, spec in enumerate(specs):
        signing = Signing(pick(known, spec.key, spec.text), spec.sign == "require", number) if spec.sign else None
        found.append(Gate(spec.sieve if number < len(specs) - stations else Sieve(), signing))
    return found
