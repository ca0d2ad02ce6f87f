"""Flight dynamics of the simulated aircraft: JSBSim in SI, NED and FRD.

The module uses nothing from the physics of the twin, so that the twin is tested on independent physics.
"""

from math import atan2, cos, degrees, hypot, sin
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jsbsim
import numpy as np

from fleet.frames import Origin, to_ned
from fleet.simulator.vehicle.types import TYPES, AircraftType
from fleet.simulator.vehicle.weather import FT, wind_at_20ft

DT = 0.01  # physics step [s]
KG_TO_LB = 2.2046226218
_SLUG_FT3, _PSF = 515.378819, 47.880259  # [kg/m3], [Pa]
_READ_PROPERTIES = (
    *("position/lat-geod-rad", "position/long-gc-rad", "position/geod-alt-ft"),
    *("velocities/v-north-fps", "velocities/v-east-fps", "velocities/v-down-fps"),
    *("attitude/phi-rad", "attitude/theta-rad", "attitude/psi-rad"),
    *("velocities/p-rad_sec", "velocities/q-rad_sec", "velocities/r-rad_sec"),
    *("accelerations/a-pilot-x-ft_sec2", "accelerations/a-pilot-y-ft_sec2", "accelerations/a-pilot-z-ft_sec2"),
    *("velocities/vt-fps", "aero/alpha-rad", "aero/beta-rad", "atmosphere/rho-slugs_ft3"),
    *("atmosphere/P-psf", "atmosphere/T-R"),
)
_SURFACES = ("fcs/aileron-cmd-norm", "fcs/elevator-cmd-norm", "fcs/rudder-cmd-norm")
_MIXTURE = 0.87  # mixture of a piston engine at these heights [-]
_HERE = Path(__file__).parent


class Truth(NamedTuple):
    """True state, without sensor errors."""

    p: np.ndarray  # position, NED from the origin, (3,) [m]
    v: np.ndarray  # velocity over ground, NED, (3,) [m/s]
    euler: np.ndarray  # phi theta psi, (3,) [rad]
    rates: np.ndarray  # p q r, FRD, (3,) [rad/s]
    force: np.ndarray  # specific force at the centre of gravity, FRD, (3,) [m/s2]
    Va: float  # true airspeed [m/s]
    alpha: float  # [rad]
    beta: float  # [rad]
    rho: float  # air density [kg/m3]
    P: float  # static pressure [Pa]
    T: float  # of the air outside [K]


class Aircraft:
    """One JSBSim aircraft with random variations of its parameters."""

    def __init__(
        self,
        origin: Origin,
        seed: int,
        turbulence: int = 0,
        kind: AircraftType = TYPES["small"],
        gusts: tuple[int, float] | None = None,
    ):
        """Load the model and draw its variations.

        Args:
            origin: origin of the NED frame
            seed: seed of mass, coefficients and turbulence
            turbulence: MIL-F-8785C severity, 0..7
            kind: aircraft type
            gusts: seed of turbulence, and wind at 20 ft that sets it below 1000 ft [ft/s]; None: from the severity
        Raises:
            RuntimeError: when JSBSim cannot load its aircraft file; reinstall the package.
        """
        self._fdm, self.kind = _create_executive(kind), kind
        self._control_names = (*_SURFACES, kind.throttle_property)
        self._nodes = {
            name: self._fdm.get_property_manager().get_node(name) for name in (*_READ_PROPERTIES, *self._control_names)
        }
        self._getters = [self._nodes[name].get_double_value for name in _READ_PROPERTIES]
        self._origin = origin
        corner = np.array([[origin.lat_e7 + 10_000, origin.lon_e7 + 10_000, origin.alt_mm]])  # to_ned is linear
        north, east, _ = to_ned(origin, *corner.T)[0]
        self._per_rad = north / np.radians(1e-3), east / np.radians(1e-3)  # [m/rad]
        for name, value in kind.settings.items():
            self._fdm[name] = value
        self._draw_variations(np.random.default_rng((seed, 1)))
        self._turbulence = turbulence
        self._gust_seed, self._w20_fps = gusts or (seed, wind_at_20ft(turbulence))

    def _draw_variations(self, rng: np.random.Generator) -> None:
        self.payload_kg = rng.uniform(*self.kind.payload_kg)
        self._fdm[f"inertia/pointmass-weight-lbs{self.kind.payload_index}"] = self.payload_kg * KG_TO_LB
        for name, spread in self.kind.spread.items():
            self._fdm[f"vary/{name}"] = 1 + spread * float(np.clip(rng.standard_normal(), -2, 2))
        for name, spread in self.kind.offsets.items():
            self._fdm[f"vary/{name}"] = spread * float(np.clip(rng.standard_normal(), -2, 2))

    def start(self, p: np.ndarray, psi: float, Va: float, wind: tuple[float, float]) -> tuple[float, float, float]:
        """Initialise the aircraft in trimmed level flight in wind.

        Args:
            p: position, NED from the origin, (3,) [m]
            psi: heading [rad]
            Va: airspeed [m/s]
            wind: north, east, direction it blows to [m/s]
        Returns:
            theta [rad], delta_e, delta_t at trim
        """
        fdm = self._fdm
        fdm["simulation/randomseed"] = self._gust_seed % 2**31
        fdm["ic/terrain-elevation-ft"] = self._origin.alt_mm * 1e-3 / FT
        fdm["ic/lat-geod-deg"] = self._origin.lat_e7 * 1e-7 + degrees(p[0] / self._per_rad[0])
        fdm["ic/long-gc-deg"] = self._origin.lon_e7 * 1e-7 + degrees(p[1] / self._per_rad[1])
        fdm["ic/h-sl-ft"] = (self._origin.alt_mm * 1e-3 - p[2]) / FT
        fdm["ic/psi-true-rad"] = psi
        fdm["ic/phi-rad"] = 0.0
        trim = self._trim_engine(Va) if self.kind.from_jsbsim else self._trim(Va)
        fdm["ic/vw-mag-fps"] = hypot(*wind) / FT
        fdm["ic/vw-dir-deg"] = degrees(atan2(wind[1], wind[0])) % 360
        fdm["ic/vn-fps"] = (Va * cos(psi) + wind[0]) / FT
        fdm["ic/ve-fps"] = (Va * sin(psi) + wind[1]) / FT
        fdm["ic/vd-fps"] = 0.0
        fdm["atmosphere/turb-type"] = 3 if self._turbulence else 0
        fdm["atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"] = self._w20_fps
        fdm["atmosphere/turbulence/milspec/severity"] = float(self._turbulence)
        fdm.run_ic()
        fdm.set_trim_status(False)
        if self.kind.from_jsbsim:
            fdm["propulsion/set-running"] = -1
        self.set_wind(*wind)
        return trim

    def _trim_engine(self, Va: float) -> tuple[float, float, float]:
        """Start the engine and trim with JSBSim; transfer the pitch trim to the elevator."""
        fdm = self._fdm
        fdm["ic/vt-fps"], fdm["ic/gamma-deg"] = Va / FT, 0.0
        fdm["propulsion/magneto_cmd"], fdm["fcs/mixture-cmd-norm"] = 3, _MIXTURE
        fdm[self.kind.throttle_property] = 0.6
        fdm.run_ic()
        fdm["propulsion/set-running"] = -1
        fdm["simulation/do_simple_trim"] = 0  # longitudinal
        theta, delta_e = fdm["attitude/theta-rad"], -fdm["fcs/pitch-trim-cmd-norm"]
        delta_t = fdm[self.kind.throttle_property]
        fdm["fcs/pitch-trim-cmd-norm"] = 0.0
        fdm["ic/alpha-rad"] = fdm["ic/theta-rad"] = theta
        self.set_controls(0.0, delta_e, 0.0, delta_t)
        return float(theta), float(delta_e), float(delta_t)

    def _trim(self, Va: float) -> tuple[float, float, float]:
        """Solve udot = wdot = qdot = 0 for alpha, delta_e, delta_t by Newton's method, without servo lags."""
        self._fdm.set_trim_status(True)
        z = np.array([0.06, 0.1, 0.4])
        for _ in range(12):
            f0 = self._accelerations(Va, z)
            if np.abs(f0).max() < 1e-6:
                break
            jacobian = np.stack([(self._accelerations(Va, z + dz) - f0) / 1e-4 for dz in 1e-4 * np.eye(3)], axis=1)
            z = np.clip(z - np.linalg.solve(jacobian, f0), [-0.1, -1.0, 0.0], [0.25, 1.0, 1.0])
        return float(z[0]), float(z[1]), float(z[2])

    def _accelerations(self, Va: float, z: np.ndarray) -> np.ndarray:
        fdm = self._fdm
        fdm["ic/vt-fps"] = Va / FT
        fdm["ic/alpha-rad"] = fdm["ic/theta-rad"] = float(z[0])
        self.set_controls(0.0, float(z[1]), 0.0, float(z[2]))
        fdm.run_ic()
        names = ("accelerations/udot-ft_sec2", "accelerations/wdot-ft_sec2", "accelerations/qdot-rad_sec2")
        return np.array([fdm[name] for name in names])

    def set_controls(self, delta_a: float, delta_e: float, delta_r: float, delta_t: float) -> None:
        """Set the commands of servos, -1..1 (+ rolls right, pitches up, yaws right), and motor, 0..1."""
        for name, value in zip(self._control_names, (delta_a, -delta_e, -delta_r, delta_t), strict=True):
            self._nodes[name].set_double_value(value)

    def set_wind(self, w_n: float, w_e: float, w_d: float = 0.0) -> None:
        """Set the mean wind, NED, direction it blows to [m/s]; turbulence is added."""
        self._fdm["atmosphere/wind-north-fps"] = w_n / FT
        self._fdm["atmosphere/wind-east-fps"] = w_e / FT
        self._fdm["atmosphere/wind-down-fps"] = w_d / FT

    def step(self) -> None:
        """Advance by DT."""
        self._fdm.run()

    def evaluate_accelerations(self) -> np.ndarray:
        """Evaluate pdot qdot rdot [rad/s2] and specific force, FRD [m/s2], without advancing time, (6,)."""
        self._fdm.suspend_integration()
        self._fdm.run()
        self._fdm.resume_integration()
        angular = [self._fdm[f"accelerations/{name}dot-rad_sec2"] for name in "pqr"]
        force = [self._fdm[f"forces/fb{axis}-total-lbs"] / self._fdm["inertia/mass-slugs"] * FT for axis in "xyz"]
        return np.array([*angular, *force])

    def truth(self) -> Truth:
        """Return the state in SI, NED and FRD."""
        x = np.array([getter() for getter in self._getters])
        origin = self._origin
        d_lon = x[1] - np.radians(origin.lon_e7 * 1e-7)  # JSBSim's longitude jumps at 180 degrees
        p = np.array(
            [
                (x[0] - np.radians(origin.lat_e7 * 1e-7)) * self._per_rad[0],
                (d_lon - 2 * np.pi * np.rint(d_lon / (2 * np.pi))) * self._per_rad[1],
                origin.alt_mm * 1e-3 - x[2] * FT,
            ]
        )
        air_data = (x[15] * FT, x[16], x[17], x[18] * _SLUG_FT3, x[19] * _PSF, x[20] / 1.8)
        return Truth(p, x[3:6] * FT, x[6:9], x[9:12], x[12:15] * FT, *map(float, air_data))

    def __getitem__(self, name: str) -> float:
        """Return a JSBSim property by its name, in its unit."""
        return float(self._fdm[name])

    def __setitem__(self, name: str, value: float) -> None:
        """Set a JSBSim property by its name, in its unit."""
        self._fdm[name] = value


def model_file(kind: AircraftType) -> Path:
    """Return the path of the aircraft file of a type, in the jsbsim package or beside this file."""
    root = Path(jsbsim.get_default_root_dir()) if kind.from_jsbsim else _HERE
    return root / "aircraft" / kind.model / f"{kind.model}.xml"


def _create_executive(kind: AircraftType) -> Any:
    """Create a JSBSim executive without log output and load an aircraft."""
    jsbsim.set_logger(jsbsim.DefaultLogger(jsbsim.LogLevel.ERROR))
    fdm = jsbsim.FGFDMExec(None if kind.from_jsbsim else str(_HERE))
    fdm.set_debug_level(0)
    with TemporaryDirectory(prefix="parauav-") as folder:
        if kind.xml is not None:  # JSBSim reads files only
            xml_path = Path(folder, kind.model, f"{kind.model}.xml")
            xml_path.parent.mkdir()
            xml_path.write_text(kind.xml)
            fdm.set_aircraft_path(folder)
        loaded = fdm.load_model(kind.model)
    if not loaded:
        location = "in the jsbsim package" if kind.from_jsbsim else "beside this file"
        raise RuntimeError(f"jsbsim: found no loadable {kind.model!r}, expected it {location}; reinstall the package")
    fdm.set_dt(DT)
    return fdm
