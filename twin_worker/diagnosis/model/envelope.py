"""Envelope of the nominal flights, and how the uncertainty of the baseline grows outside it.

The equations assume thrust and aerodynamic forces proportional to air density, the indicated airspeed to its root, and
a thrust that falls linearly with airspeed. Nominal flights test this within their envelope only. Outside, the exponent
of each law is unknown: one standard deviation is a quantity that does not change with density at all.
"""

from collections.abc import Sequence

import numpy as np

from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.model.baseline import Baseline, Envelope
from twin_worker.diagnosis.model.equations import density
from twin_worker.diagnosis.model.residual import ModelledFlight

DENSITY_SIGMA = {"thrust": 1.0, "rho": 1.0, "airspeed_scale:log_scale": 0.5}
"""Nuisance -> standard deviation of its exponent of density [-]."""
SPEED_SIGMA = {"thrust": 1.0}
"""Nuisance -> standard deviation of its exponent of airspeed [-]."""
TRIM = ("C_L", "C_l", "C_m", "C_n")
"""Nuisances that rigging, loading and battery position change from day to day."""
SAME_DAY_DAYS = 0.5  # flights further apart are of different days
_RANGE_PERCENTILES = 1.0, 99.0  # of the valid rows


def nominal_envelope(modelled_flights: Sequence[ModelledFlight]) -> Envelope:
    """Return the conditions of nominal flights."""
    flights = [modelled.flight for modelled in modelled_flights]
    ln_density = np.concatenate([_ln_density(flight) for flight in flights])
    ln_speed = np.concatenate([_ln_speed(flight) for flight in flights])
    low, high = (np.percentile(x, _RANGE_PERCENTILES).tolist() for x in (ln_density, ln_speed))
    c_z = np.concatenate([one.equation_terms().intermediate["c_z"][one.ok] for one in modelled_flights])
    days = tuple(flight.t_start / 86400.0 for flight in flights)
    return Envelope(tuple(low), tuple(high), days, (float(c_z.min()), float(c_z.max())))


def extrapolation_sigma(base: Baseline, flight: FlightData) -> dict[str, float]:
    """Return the standard deviation that extrapolation adds to nuisances of a flight, by nuisance; empty inside."""
    envelope = base.envelope
    if envelope is None or not flight.ok.any():
        return {}
    out: dict[str, float] = {}
    for sigma, x, span in (
        (DENSITY_SIGMA, _ln_density(flight), envelope.ln_density),
        (SPEED_SIGMA, _ln_speed(flight), envelope.ln_speed),
    ):
        middle = float(np.median(x))
        distance = max(span[0] - middle, middle - span[1], 0.0)
        # flights left out in turn test, in part, an extrapolation within the width of the envelope
        distance *= min(distance / max(span[1] - span[0], 1e-9), 1.0)
        for name, exponent in sigma.items():
            out[name] = float(np.hypot(out.get(name, 0.0), exponent * distance))
    return {name: x for name, x in out.items() if x > 0.0}


def is_other_day(base: Baseline, flight: FlightData) -> bool:
    """Return whether no nominal flight is of the same day."""
    days = () if base.envelope is None else base.envelope.days
    return bool(days) and min(abs(flight.t_start / 86400.0 - day) for day in days) > SAME_DAY_DAYS


def _ln_density(flight: FlightData) -> np.ndarray:
    return np.log(density(flight.readings["h"][flight.ok]))


def _ln_speed(flight: FlightData) -> np.ndarray:
    r = flight.readings
    return np.log(np.maximum(np.hypot(r["v_n"], r["v_e"])[flight.ok], 1.0))
