"""Probe the router before Zenoh connects, because Zenoh reports no reason for a failed connection."""

import socket
import ssl
from pathlib import Path

from fleet.access.entry import Entry, endpoint

_PATIENCE_S = 3.0
_REFUSAL_S = 0.3  # with TLS 1.3 a certificate is rejected only after the handshake [s]


def reachable(router: str) -> bool:
    """Return whether something accepts connections at an endpoint.

    Raises:
        ValueError: when it is not an endpoint.
    """
    try:
        with socket.create_connection(endpoint(router), timeout=0.5):
            return True
    except OSError:
        return False


def answers(entry: Entry) -> bool:
    """Return whether a router responds; with certificates, perform the TLS handshake of a session and close it.

    Raises:
        ConnectionError: when one side rejects the other; the text names the side and the reason.
        ValueError: when the own certificate is missing, expired or readable by others.
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
            f"router {entry.at}: found its certificate not valid ({error.verify_message}), expected one for this name, "
            f"signed by the authority in ca.pem; {_cure(error.verify_message)}"
        ) from None
    except ssl.SSLError as error:
        raise ConnectionError(
            f"router {entry.at}: found the certificate of {entry.role} rejected ({_said(error)}), expected one signed "
            "by the router's authority; create it again with that authority"
        ) from None
    except OSError as error:
        raise ConnectionError(
            f"router {entry.at}: found no TLS there ({error.strerror or error}), expected a handshake; check that it "
            "is the tls endpoint of a router"
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
            f"certificates: found certificate and key in {folder} that do not match ({_said(error)}), expected a "
            f"pair; create them again: certificates.sh role FOLDER {entry.role}"
        ) from None
    except OSError as error:
        raise ValueError(f"certificates: found no ca.pem in {folder} ({error.strerror}); copy the site's") from None
    return context


def _refused(secure: ssl.SSLSocket) -> None:
    """Wait briefly for a rejection; a router that accepts the client waits for its first message."""
    secure.settimeout(_REFUSAL_S)
    try:
        if not secure.recv(1):
            raise ConnectionError("it closed the connection")
    except TimeoutError:
        return


def _cure(refusal: str) -> str:
    if "not yet valid" in refusal:
        return (
            "set the clock of this machine; synchronise all machines with one time server (chrony, systemd-timesyncd)"
        )
    if "expired" in refusal:
        return "certificates.sh router FOLDER NAME... and restart the router, or set this clock if it is ahead"
    if "mismatch" in refusal:
        return "create one for this name too (certificates.sh router FOLDER NAME...), or use another name of the router"
    return "copy the site's ca.pem here, or create the router's certificate with its authority"


def _said(error: ssl.SSLError) -> str:
    return (error.reason or str(error)).replace("_", " ").lower()
