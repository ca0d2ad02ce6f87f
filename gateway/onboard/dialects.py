"""THE TABLE of how autopilots like to be asked: one row per autopilot, as `Status.autopilot` names it.

Source: ArduPilot GCS_Param.cpp, GCS_Common.cpp and MissionItemProtocol.cpp; PX4 mavlink_parameters.cpp and
mavlink_mission.cpp; MAVLink services "Parameter Protocol" (hash check) and "Message interval".
"""

from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.microservices.params import HASH


class Dialect(NamedTuple):
    """How one autopilot likes to be asked."""

    items_at_once: int = 1  # mission items asked for in one go
    probe: bool = False  # any item may be asked for at any time, not only in order after the count
    hash: str = ""  # name under which it tells the hash over all of its parameters
    fickle: tuple[str, ...] = ()  # parameters that change by themselves begin so
    streams: bool = False  # old versions know groups of messages only: REQUEST_DATA_STREAM


DIALECTS = {
    "ardupilot": Dialect(
        5, True, fickle=("STAT_", "SYS_NUM_RESETS", "BARO", "GND_", "ARSPD", "COMPASS_"), streams=True
    ),
    "px4": Dialect(hash=HASH),
}
ANY = Dialect()

STREAMS = {
    "ATTITUDE": dialect.MAV_DATA_STREAM_EXTRA1,
    "SERVO_OUTPUT_RAW": dialect.MAV_DATA_STREAM_RC_CHANNELS,
    "GLOBAL_POSITION_INT": dialect.MAV_DATA_STREAM_POSITION,
    "VFR_HUD": dialect.MAV_DATA_STREAM_EXTRA2,
    "NAV_CONTROLLER_OUTPUT": dialect.MAV_DATA_STREAM_EXTENDED_STATUS,
    "MISSION_CURRENT": dialect.MAV_DATA_STREAM_EXTENDED_STATUS,
}
"""The group a message belongs to."""
