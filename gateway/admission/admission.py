"""Admission of frames of one link: message filter and signature check."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from fleet.telemetry.mavlink.parsing.decode import Frames
from gateway.admission.signing import Signing, read_keys, select_key
from gateway.settings.link_spec import LinkSpec, MessageFilter

FILTERED = "excluded by the filter of the link"


class Admission:
    """Admission of frames of one link.

    Args:
        message_filter: filter of frames
        signing: signature check; None: signatures are not checked
    """

    def __init__(self, message_filter: MessageFilter, signing: Signing | None = None) -> None:
        self._filter, self._signing = message_filter, signing

    def admit(self, frames: Frames, refused: Counter[str]) -> Frames:
        """Return the accepted frames, and count the refused ones by reason."""
        if self._signing is not None and len(frames.headers):
            frames = frames.subset(self._signing.verify(frames, refused))
        if self._filter.rules and len(frames.headers):
            passed = self._filter.passes(frames.headers)
            refused[FILTERED] += int((~passed).sum())
            frames = frames.subset(passed)
        return frames

    def sign(self, message: bytes) -> bytes:
        """Return an outgoing message, signed if the link requires it."""
        return message if self._signing is None else self._signing.sign(message)


def make_admissions(specs: Sequence[LinkSpec], stations: int = 0, keys: Path | None = None) -> list[Admission]:
    """Create the admission of each link; the filter of a station's link applies to frames sent there, not received.

    Args:
        specs: the links
        stations: number of links to ground stations, the last ones
        keys: file of keys
    Raises:
        ValueError: when the file of keys is readable by others, or lacks the key of a link.
        OSError: when it cannot be read.
    """
    keys_by_name = read_keys(keys) if keys is not None else {}
    admissions = []
    for number, spec in enumerate(specs):
        signing = (
            Signing(select_key(keys_by_name, spec.key, spec.text), spec.sign == "require", number)
            if spec.sign
            else None
        )
        admissions.append(
            Admission(spec.message_filter if number < len(specs) - stations else MessageFilter(), signing)
        )
    return admissions
