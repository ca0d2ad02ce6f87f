"""Compile or load the receiver before the first data arrive; data during compilation would be lost."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.intake import Intake


def warm_up() -> None:
    """Receive whole and split messages, so that all decoder paths are compiled."""
    voice, intake = dialect.MAVLink(None, srcSystem=1, srcComponent=1), Intake()
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_GENERIC, 0, 0, 0, 3)
    told = bytes(beat.pack(voice)) + bytes(dialect.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0).pack(voice))
    for t, data in ((0.0, told), (1.0, told[:20]), (2.0, told[20:])):
        intake.hear(t, data)
        intake.pack(t)
