"""Grade one report against its label: names, location, onset, parameters and standard deviations."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

_ACTUATOR = ("actuator", "pitch", "roll", "yaw")
_LOADS = ("lift", "drag", "force_x", "force_z")
CHANNELS: Mapping[str, tuple[str, ...]] = {  # effect: correct channels
    "wind_steady": ("air",),
    "wind_shear": ("air",),
    "turbulence": ("air",),
    "gust_discrete": ("air",),
    "updraft": ("air",),
    "air_density": ("air", "dynamic_pressure"),
    "actuator_lag": _ACTUATOR,
    "actuator_delay": _ACTUATOR,
    "actuator_rate_limit": _ACTUATOR,
    "actuator_deadband": _ACTUATOR,
    "actuator_saturation": _ACTUATOR,
    "actuator_offset": _ACTUATOR,
    "actuator_stuck": _ACTUATOR,
    "control_effectiveness_loss": _ACTUATOR,
    "prop_torque": ("roll",),
    "p_factor": ("yaw", "pitch"),
    "slipstream_tail": ("pitch", "yaw"),
    "thrust_loss": ("thrust", "force_x"),
    "thrust_asymmetry": ("yaw", "thrust"),
    "drag_increase": ("drag", "force_x"),
    "icing": _LOADS,
    "flap_deployed": _LOADS,
    "stall": _LOADS,
    "ground_effect": _LOADS,
    "mass_change": ("mass", "force_z", "lift"),
    "cg_shift": ("pitch", "mass", "roll"),
    "airspeed_scale": ("airspeed",),
    "airspeed_bias": ("airspeed",),
    "gps_latency": ("gps",),
    "imu_misalignment": ("imu",),
    "gyro_bias": ("gyro", "imu"),
    "accel_bias": ("accel", "imu"),
    "heading_bias": ("heading",),
    "baro_bias": ("baro",),
}
_DIRECTION_SCALE_DEG = 45.0  # direction error that counts as an error of 100 %
_MIN_RATIO_CHANGE = {"density_ratio": 0.01, "scale": 0.01}  # smallest |ratio - 1| used as denominator


@dataclass(frozen=True)
class ScoredParameter:
    """One parameter: name, true value, reported value and its standard deviation; None where not reported."""

    name: str
    truth: float
    told: float | None
    sigma: float | None

    @property
    def error(self) -> float:
        """Return the error relative to the true value; directions relative to 45 degrees, small angles to 1 degree."""
        if self.told is None:
            return 1.0
        if self.name == "from_deg":
            return self.deviation / _DIRECTION_SCALE_DEG
        if self.name in _MIN_RATIO_CHANGE:
            return self.deviation / max(abs(self.truth - 1.0), _MIN_RATIO_CHANGE[self.name])
        floor = 1.0 if self.name.endswith("_deg") and self.name != "bias_deg" else 1e-6
        return self.deviation / max(abs(self.truth), floor)

    @property
    def deviation(self) -> float:
        """Return |reported - true|; directions modulo 360 degrees."""
        difference = (self.told or 0.0) - self.truth
        return abs((difference + 180.0) % 360.0 - 180.0 if self.name == "from_deg" else difference)

    @property
    def covered(self) -> bool | None:
        """Return whether the true value lies within two standard deviations; None where none is reported."""
        return self.deviation <= 2.0 * self.sigma if self.sigma else None


@dataclass(frozen=True)
class GradedFlight:
    """Grade of one flight.

    Attributes:
        flight, airframe, role: nominal, control, single, compound or unknown
        concealed, named: names of the true and of the reported effects, reported best first
        verdict: none, named or unknown; sentence: summary of the report
        rivals: equivalent effects of each named one
        late: reported minus true onset and its tolerance, for each effect [s]
        sizes: parameters of correctly named effects
        located, surfaces: whether channel and surface are correct, for correctly named effects
        before, after: residual on held-out blocks, None where nothing was named
        acts: strength of the effect in standard deviations of the sensors
    """

    flight: str
    airframe: str
    role: str
    concealed: tuple[str, ...]
    named: tuple[str, ...]
    verdict: str
    sentence: str
    rivals: tuple[tuple[str, ...], ...] = ()
    late: tuple[tuple[float, float], ...] = ()
    sizes: tuple[tuple[str, ScoredParameter], ...] = ()
    located: tuple[bool, ...] = ()
    surfaces: tuple[bool, ...] = ()
    before: float | None = None
    after: float | None = None
    acts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def reported_names(self) -> tuple[str, ...]:
        """Return the reported names, else `unknown` or `nothing`."""
        return self.named or ("unknown" if self.verdict == "unknown" else "nothing",)

    @property
    def hit(self) -> bool:
        """Return whether the report is correct for the role of the flight."""
        if self.role == "control":
            return not self.named and self.verdict != "unknown"
        if self.role == "unknown":
            return self.verdict == "unknown"
        if self.role == "single":
            return self.named[:1] == self.concealed
        return set(self.named) == set(self.concealed)

    @property
    def in_class(self) -> bool:
        """Return whether a single effect is the first name or equivalent to it."""
        return self.hit or (bool(self.named) and self.concealed[0] in self.rivals[0])


def grade(flight: str, label: Mapping[str, Any], report: Mapping[str, Any] | None) -> GradedFlight:
    """Grade one report; a flight without a report was rejected."""
    diagnosis = report or {"verdict": "none", "sentence": "no report: the flight was rejected", "named": []}
    named = tuple(name.split(":")[0] for name in diagnosis["named"])
    onset_errors, sizes, located, surfaces = [], [], [], []
    for effect in label["effects"]:
        if effect["name"] not in named:
            continue
        i = named.index(effect["name"])
        location = diagnosis["located"][i]
        located.append(location["channel"] in CHANNELS[effect["name"]])
        if effect.get("surface"):
            surfaces.append(location["surface"] == effect["surface"])
        if effect.get("t0") and location["segments"]:
            onset_errors.append((location["segments"][0][0] - effect["t0"], 5.0 + 0.2 * effect.get("ramp_s", 0.0)))
        sizes += [
            (
                effect["name"],
                ScoredParameter(name, truth, diagnosis["parameters"][i].get(name), diagnosis["sigma"][i].get(name)),
            )
            for name, truth in effect["params"].items()
        ]
    return GradedFlight(
        flight=flight,
        airframe=label["airframe"],
        role=label["role"],
        concealed=tuple(effect["name"] for effect in label["effects"]),
        named=named,
        verdict=diagnosis["verdict"],
        sentence=diagnosis["sentence"],
        rivals=tuple(tuple(names) for names in diagnosis.get("equivalents", ())),
        late=tuple(onset_errors),
        sizes=tuple(sizes),
        located=tuple(located),
        surfaces=tuple(surfaces),
        before=diagnosis.get("fit_before") if named else None,
        after=diagnosis.get("fit_after") if named else None,
        acts=label.get("acts", {}),
    )
