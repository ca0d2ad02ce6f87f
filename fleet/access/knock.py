"""Try the router's door before Zenoh does, which would say no more than that it found it closed."""

import socket
import ssl
from pathlib import Path

from fleet.access.entry import Entry, endpoint

_PATIENCE_S = 3.0
_REFUSAL_S = 0.3  # with TLS 1.3 a certificate is refused only after the handshake [s]


def reachable(router: str) -> bool:
    """Return whether something accepts connections at an endpoint.

    Raises:
        ValueError: when it is no endpoint.
    """
    try:
        with socket.create_connection(endpoint(router), timeout=0.5):
            return True
    except OSError:
        return False


def answers(entry: Entry) -> bool:
    """Return whether a router is there; with certificates, shake hands as a session would, and let go again.

    Raises:
        ConnectionError: when one side refuses the other; the sentence says which and why.
        ValueError: when our own certificate is missing, expired or open to others.
    """
    if entry.certificates is None:
        return reachable(entry.at)
    context = _context(entry, entry.certificates)
    host, port = endpoint(entry.at)
    try:
        plain = socket.create_connection((host, port), timeout=_PATIENCE_S)
    except OSError:
        return False
    try:
        with plain, context.wrap_socket(plain, server_hostname=host) as secure:
            _refused(secure)
    except ssl.SSLCertVerificationError as error:
        raise ConnectionError(
            f"router {entry.at}: found its certificate not to be believed ({error.verify_message}), expected one for "
            f"this name, by the authority in ca.pem; {_cure(error.verify_message)}"
        ) from None
    except ssl.SSLError as error:
        raise ConnectionError(
            f"router {entry.at}: found it refuses us as {entry.role} ({_said(error)}), expected it to know our "
            "certificate; have it made anew by the authority the router trusts"
        ) from None
    except OSError as error:
        raise ConnectionError(
            f"router {entry.at}: found no TLS there ({error.strerror or error}), expected a handshake; is it the tls "
            "endpoint of a router?"
        ) from None
    return True


def _context(entry: Entry, folder: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(folder / "ca.pem")
        if (own := entry.papers()) is not None:
            context.load_cert_chain(*own)
    except ssl.SSLError as error:
        raise ValueError(
            f"certificates: found {folder} to hold what does not fit together ({_said(error)}), expected a certificate "
            f"with its key; make them again: certificates.sh role FOLDER {entry.role}"
        ) from None
    except OSError as error:
        raise ValueError(f"certificates: {folder} holds no ca.pem ({error.strerror}); copy the site's") from None
    return context


def _refused(secure: ssl.SSLSocket) -> None:
    """Wait a moment for a refusal; a router that is content waits for us to begin."""
    secure.settimeout(_REFUSAL_S)
    try:
        if not secure.recv(1):
            raise ConnectionError("it hung up")
    except TimeoutError:
        return


def _cure(refusal: str) -> str:
    if "not yet valid" in refusal:
        return "set the clock of this machine, and let all follow one time server (chrony, systemd-timesyncd)"
    if "expired" in refusal:
        return "certificates.sh router FOLDER NAME... and restart the router, or set this clock if it is ahead"
    if "mismatch" in refusal:
        return "make one for this name too (certificates.sh router FOLDER NAME...), or call the router by another name"
    return "copy the site's ca.pem here, or have the router's certificate made by its authority"


def _said(error: ssl.SSLError) -> str:
    return (error.reason or str(error)).replace("_", " ").lower()
