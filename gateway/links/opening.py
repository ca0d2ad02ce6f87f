"""Open a link from its specification."""

from fleet.telemetry.recording.ids import Ids
from gateway.links.link import Link
from gateway.links.recorded import Replay
from gateway.links.stream_client import Dialled
from gateway.links.tcp_listener import TcpListener
from gateway.links.udp import Udp
from gateway.settings.link_spec import Spec


def open_link(spec: Spec, ids: Ids) -> Link:
    """Open a link; a listening link binds its port now, an outgoing one connects in `start`.

    Raises:
        ValueError, OSError: when the recording does not exist, or the port is in use.
    """
    if spec.kind == "replay":
        return Replay(spec, ids)
    if spec.kind == "tcpin":
        return TcpListener(spec)
    if spec.kind in ("tcp", "serial"):
        return Dialled(spec)
    return Udp(spec)
