"""Probe the router before Zenoh connects, because Zenoh reports no reason for a failed connection."""

import socket
import ssl
from contextlib import suppress
from pathlib import Path

from fleet.access.entry import BusConfig, parse_endpoint

_CONNECT_TIMEOUT_S = 3.0
_REJECTION_WAIT_S = 0.3  # with TLS 1.3 a certificate is rejected only after the handshake [s]


def accepts_connections(router: str) -> bool:
    """Return whether something accepts connections at an endpoint.

    Raises:
        ValueError: when it is not an endpoint.
    """
    try:
        with socket.create_connection(parse_endpoint(router), timeout=0.5):
            return True
    except OSError:
        return False


def probe_router(bus_config: BusConfig) -> bool:
    """Return whether a router responds; with certificates, perform the TLS handshake of a session and close it.

    Raises:
        ConnectionError: when one side rejects the other; the text names the side and the reason.
        ValueError: when the own certificate is missing, expired or readable by others.
    """
    if bus_config.certificates is None:
        return accepts_connections(bus_config.endpoint)
    context = _tls_context(bus_config, bus_config.certificates)
    host, port = parse_endpoint(bus_config.endpoint)
    try:
        tcp = socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT_S)
    except OSError:
        return False
    try:
        with tcp, context.wrap_socket(tcp, server_hostname=host) as tls:
            tls.settimeout(_REJECTION_WAIT_S)
            with suppress(TimeoutError):  # a router that accepts the client waits for its first message
                if not tls.recv(1):
                    raise ConnectionError("it closed the connection")
    except ssl.SSLCertVerificationError as error:
        raise ConnectionError(
            f"router {bus_config.endpoint}: found its certificate not valid ({error.verify_message}), expected one "
            f"for this name, signed by the authority in ca.pem; {_remedy(error.verify_message)}"
        ) from None
    except ssl.SSLError as error:
        reason = f"found the certificate of {bus_config.role} rejected ({_reason_text(error)})"
        remedy = "expected one signed by the router's authority; create it again with that authority"
        raise ConnectionError(f"router {bus_config.endpoint}: {reason}, {remedy}") from None
    except OSError as error:
        raise ConnectionError(
            f"router {bus_config.endpoint}: found no TLS there ({error.strerror or error}), expected a handshake; "
            "check that it is the tls endpoint of a router"
        ) from None
    return True


def _tls_context(bus_config: BusConfig, folder: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(folder / "ca.pem")
        if (pair := bus_config.certificate_pair()) is not None:
            context.load_cert_chain(*pair)
    except ssl.SSLError as error:
        raise ValueError(
            f"certificates: found certificate and key in {folder} that do not match ({_reason_text(error)}), "
            f"expected a pair; create them again: certificates.sh role FOLDER {bus_config.role}"
        ) from None
    except OSError as error:
        raise ValueError(f"certificates: found no ca.pem in {folder} ({error.strerror}); copy the site's") from None
    return context


def _remedy(rejection: str) -> str:
    if "not yet valid" in rejection:
        return (
            "set the clock of this machine; synchronise all machines with one time server (chrony, systemd-timesyncd)"
        )
    if "expired" in rejection:
        return "certificates.sh router FOLDER NAME... and restart the router, or set this clock if it is ahead"
    if "mismatch" in rejection:
        return "create one for this name too (certificates.sh router FOLDER NAME...), or use another name of the router"
    return "copy the site's ca.pem here, or create the router's certificate with its authority"


def _reason_text(error: ssl.SSLError) -> str:
    return (error.reason or str(error)).replace("_", " ").lower()
