"""Compile or load the receiver before the first data arrive; data during compilation would be lost."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.intake import MavlinkReceiver


def warm_up() -> None:
    """Receive whole and split messages, so that all decoder paths are compiled."""
    encoder, receiver = dialect.MAVLink(None, srcSystem=1, srcComponent=1), MavlinkReceiver()
    heartbeat = dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_GENERIC, 0, 0, 0, 3
    )
    packet = bytes(heartbeat.pack(encoder)) + bytes(dialect.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0).pack(encoder))
    for t, data in ((0.0, packet), (1.0, packet[:20]), (2.0, packet[20:])):
        receiver.receive(t, data)
        receiver.flush_packed(t)
