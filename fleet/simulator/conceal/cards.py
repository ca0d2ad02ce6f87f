"""Airframe data that an operator has before any flight: mass with average payload, inertia, geometry, throws."""

from math import degrees

import numpy as np

from fleet.simulator.conceal.paths import EXAM_HOME
from fleet.simulator.vehicle.altered import instrumented_type
from fleet.simulator.vehicle.jsbsim import KG_TO_LB, Aircraft
from fleet.simulator.vehicle.weather import FT

_SLUG_FT2 = 1.3558179483  # [kg m2]
_THROW_DEG = {  # for command -1 and +1; + rolls right, pitches up, yaws right
    "c172p": {"aileron": [-20.0, 15.0], "elevator": [-23.0, 28.0], "rudder": [-16.0, 16.0]},
    "small": {name: [-degrees(0.4363), degrees(0.4363)] for name in ("aileron", "elevator", "rudder")},
}
_START_NED = np.array([0.0, 0.0, -150.0])  # NED from home [m]
_PROPELLER_M = {"c172p": 1.905, "small": 0.508}


def card(airframe: str) -> dict[str, object]:
    """Return the data of an airframe in SI; throws in degrees."""
    kind = instrumented_type(airframe)
    aircraft = Aircraft(EXAM_HOME, 0, kind=kind)
    aircraft[f"inertia/pointmass-weight-lbs{kind.payload_index}"] = sum(kind.payload_kg) / 2 * KG_TO_LB
    aircraft.start(_START_NED, 0.0, kind.cruise, (0.0, 0.0))
    inertia = {f"I{axes}": aircraft[f"inertia/i{axes}-slugs_ft2"] * _SLUG_FT2 for axes in ("xx", "yy", "zz")}
    return {
        "airframe": airframe,
        "m": aircraft["inertia/weight-lbs"] / KG_TO_LB,
        "S": aircraft["metrics/Sw-sqft"] * FT**2,
        "b": aircraft["metrics/bw-ft"] * FT,
        "c": aircraft["metrics/cbarw-ft"] * FT,
        **inertia,
        "Ixz": -aircraft["inertia/ixz-slugs_ft2"] * _SLUG_FT2,  # product of inertia; JSBSim returns the matrix element
        "Dprop": _PROPELLER_M[airframe],
        "surface_full_deg": _THROW_DEG[airframe],
    }
