"""MAV_CMD numbers of navigation items and their names on the page."""

# MAV_CMD. Source: MAVLink common.xml.
WAYPOINT, LOITER_UNLIM, LOITER_TURNS, LOITER_TIME, RTL, LAND, TAKEOFF, LOITER_TO_ALT = 16, 17, 18, 19, 20, 21, 22, 31
SPLINE, VTOL_TAKEOFF, VTOL_LAND, DO_JUMP = 82, 84, 85, 177

ITEM_NAMES = {
    WAYPOINT: "waypoint",
    LOITER_UNLIM: "loiter",
    LOITER_TURNS: "loiter turns",
    LOITER_TIME: "loiter for a time",
    RTL: "return",
    LAND: "land",
    TAKEOFF: "take-off",
    LOITER_TO_ALT: "loiter to altitude",
    SPLINE: "spline waypoint",
    VTOL_TAKEOFF: "VTOL take-off",
    VTOL_LAND: "VTOL landing",
    DO_JUMP: "jump",
}
