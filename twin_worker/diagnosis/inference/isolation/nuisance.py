"""Nuisance parameters: nominal differences between flights, such as turn-on biases, weather, trim, small scatter.

Each has a spread, from the sensor specification or estimated on left-out nominal flights. Values within the spread are
absorbed. A nuisance beyond it is fixed at zero, so that the fault hypotheses explain the difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleet.effects import Effect, Parameter, Stage, catalogue
from twin_worker.diagnosis.data.card import ALWAYS, FaultHypothesis

_SHARE_FLOOR = 0.03  # least spread of a derivative without a fast accelerometer [-]
MAX_SPREAD_RATIO = 4.0  # largest estimated spread over its floor
RELEASE_SIGMAS = 2.5  # spreads beyond which a difference is no longer a nuisance
SENSOR_RELEASE_SIGMAS = 3.3  # the same for sensor biases, which data sheets specify

DRIFT_HARMONICS = 3  # cosine harmonics of a slow drift
_DRIFT_FLOORS = {  # drift during a flight: effect -> floor of the drift over the floor of the mean
    "accel_bias": 0.4,
    "gyro_bias": 0.3,
    "heading_bias": 0.25,
    "imu_misalignment": 0.4,
    "wind_steady": 0.1,
}

_SHARES = ("L:delta_a", "L:p", "L:beta", "M:delta_e", "M:c_z", "M:q", "N:delta_r", "N:r", "N:beta")
_OFFSET_FLOORS = {  # least spread of each offset
    "C_L": 0.004,
    "C_D": 0.0005,
    "C_l": 0.0001,
    "C_m": 0.0003,
    "C_n": 0.0001,
    "thrust": 0.005,
    "rho": 0.003,
    "side": 0.05,
}
_QNH_M, _LAPSE = 30.0, 5.0  # sea level pressure as a height [m], and lapse rate [m per 100 m], unknown


def _act(flow: object, x: object, of: str) -> dict[str, object]:
    return {of: x}


SCATTER = Effect(
    name="scatter",
    stage=Stage.WRENCH,
    channel="",
    equation="coefficient + offset",
    source="spread of nominal flights",
    parameters=(Parameter("x", "-", "offset", step=0.01, low=-1.0, high=1.0),),
    act=_act,
    examples=((0.01,),),
    targets=(*_SHARES, *_OFFSET_FLOORS),
)
LAPSE = replace(SCATTER, name="lapse", act=lambda flow, x: {"baro": x * flow.height / 100.0}, targets=())
DENSITY = replace(SCATTER, stage=Stage.AIR)


@dataclass(frozen=True)
class Nuisance:
    """One nuisance parameter.

    Attributes:
        name: key of `Baseline.spread`
        effect, of, index: effect, target and index of the parameter
        floor: least spread
        step: step for finite differences
    """

    name: str
    effect: Effect
    target: str
    index: int
    floor: float
    step: float

    def hypothesis(self, x: float) -> FaultHypothesis:
        """Return the effect with this parameter at x and the others at zero."""
        par = [0.0] * self.effect.n_parameters
        par[self.index] = x
        return FaultHypothesis(self.effect, self.target, tuple(par), ALWAYS)

    @property
    def is_sensor_bias(self) -> bool:
        """Return whether this is a sensor bias."""
        return self.effect.name in ("accel_bias", "gyro_bias", "heading_bias", "imu_misalignment")

    @property
    def release_sigmas(self) -> float:
        """Return the number of spreads beyond which this is no longer a nuisance."""
        return SENSOR_RELEASE_SIGMAS if self.is_sensor_bias else RELEASE_SIGMAS

    @property
    def is_unbounded(self) -> bool:
        """Return whether no effect in the catalogue can explain this difference, so that it stays a nuisance."""
        return self.target == "side" or self.name in ("baro", "lapse")

    @property
    def is_wind(self) -> bool:
        """Return whether this is wind, of which any amount may be nominal."""
        return self.effect.name in ("wind_steady", "wind_shear")


@dataclass(frozen=True)
class DriftMode:
    """Slow drift of one nuisance: a cosine with some half waves over the flight.

    Attributes:
        name: key of `Baseline.spread`
        nuisance_index: index of the nuisance that drifts
        half_waves: number of half waves
        floor: least spread
    """

    name: str
    nuisance_index: int
    half_waves: int
    floor: float


def drift_modes(vane: bool) -> tuple[DriftMode, ...]:
    """List the drift modes of all drifting nuisances; none without a fast accelerometer, where noise covers them."""
    return tuple(
        DriftMode(f"{n.name}~{half_waves}", k, half_waves, _DRIFT_FLOORS[n.effect.name] * n.floor)
        for k, n in enumerate(list_nuisances(vane) if vane else ())
        if n.effect.name in _DRIFT_FLOORS
        for half_waves in range(1, DRIFT_HARMONICS + 1)
    )


def drift_slopes(columns: np.ndarray, modes: Sequence[DriftMode], t: np.ndarray) -> np.ndarray:
    """Return the slopes of drift modes, (n, c, modes), from those of the nuisances, (n, c, nuisances), at t (n,)."""
    share = (t - t[0]) / max(t[-1] - t[0], 1e-9)
    waves = np.sqrt(2.0) * np.cos(np.pi * np.outer(share, [mode.half_waves for mode in modes]))
    return columns[:, :, [mode.nuisance_index for mode in modes]] * waves[:, None, :]


def list_nuisances(vane: bool) -> tuple[Nuisance, ...]:
    """List all nuisances; without a fast accelerometer also the less accurate derivatives."""
    effects = catalogue()
    out = []

    def add(name: str, floor: float, targets: tuple[str, ...] = ("",)) -> None:
        effect = effects[name]
        for target in targets:
            for k, parameter in enumerate(effect.parameters):
                label = ":".join(filter(None, (name, target, parameter.name)))
                out.append(Nuisance(label, effect, target, k, floor, 0.3 * parameter.step))

    add("accel_bias", 0.04, effects["accel_bias"].targets)
    add("gyro_bias", 0.0015, effects["gyro_bias"].targets)
    add("heading_bias", 0.012)
    add("wind_steady", 0.35)
    add("wind_shear", 0.2)
    add("imu_misalignment", 0.004)
    add("airspeed_scale", 0.003)
    for target, floor in _OFFSET_FLOORS.items():
        out.append(Nuisance(target, DENSITY if target == "rho" else SCATTER, target, 0, floor, floor))
    out.append(Nuisance("baro", effects["baro_bias"], "", 0, _QNH_M, 1.0))
    out.append(Nuisance("lapse", LAPSE, "", 0, _LAPSE, 0.5))
    if not vane:
        out += [Nuisance(target, SCATTER, target, 0, _SHARE_FLOOR, _SHARE_FLOOR) for target in _SHARES]
    return tuple(out)
