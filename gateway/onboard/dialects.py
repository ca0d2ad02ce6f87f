"""Request protocol of each autopilot, by `Status.autopilot`.

Source: ArduPilot GCS_Param.cpp, GCS_Common.cpp and MissionItemProtocol.cpp; PX4 mavlink_parameters.cpp and
mavlink_mission.cpp; MAVLink services "Parameter Protocol" (hash check) and "Message interval".
"""

from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.microservices.params import HASH_NAME


class RequestDialect(NamedTuple):
    """Request protocol of one autopilot."""

    items_at_once: int = 1  # mission items requested at once
    probe: bool = False  # any item may be requested at any time, not only in order after the count
    hash: str = ""  # name of the parameter with the hash over all parameters
    volatile: tuple[str, ...] = ()  # prefixes of parameters that the autopilot changes itself
    streams: bool = False  # old versions support only groups of messages: REQUEST_DATA_STREAM


DIALECTS = {
    "ardupilot": RequestDialect(
        5, True, volatile=("STAT_", "SYS_NUM_RESETS", "BARO", "GND_", "ARSPD", "COMPASS_"), streams=True
    ),
    "px4": RequestDialect(hash=HASH_NAME),
}
ANY = RequestDialect()

STREAMS = {
    "ATTITUDE": dialect.MAV_DATA_STREAM_EXTRA1,
    "SERVO_OUTPUT_RAW": dialect.MAV_DATA_STREAM_RC_CHANNELS,
    "GLOBAL_POSITION_INT": dialect.MAV_DATA_STREAM_POSITION,
    "VFR_HUD": dialect.MAV_DATA_STREAM_EXTRA2,
    "NAV_CONTROLLER_OUTPUT": dialect.MAV_DATA_STREAM_EXTENDED_STATUS,
    "MISSION_CURRENT": dialect.MAV_DATA_STREAM_EXTENDED_STATUS,
}
"""Stream group of each message."""
