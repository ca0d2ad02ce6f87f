"""Open a link from its specification."""

from fleet.telemetry.recording.ids import IdAllocator
from gateway.link_spec import LinkSpec
from gateway.links.link import Endpoint
from gateway.links.receive import Udp
from gateway.links.recorded import ReplayLink
from gateway.links.stream import StreamClient
from gateway.links.tcp_listener import TcpListener


def open_link(spec: LinkSpec, ids: IdAllocator) -> Endpoint:
    """Open a link; a listening link binds its port now, an outgoing one connects in `start`.

    Raises:
        ValueError, OSError: when the recording does not exist, or the port is in use.
    """
    if spec.kind == "replay":
        return ReplayLink(spec, ids)
    if spec.kind == "tcpin":
        return TcpListener(spec)
    if spec.kind in ("tcp", "serial"):
        return StreamClient(spec)
    return Udp(spec)
