"""Airframes: prior data of an aircraft type, one TOML file each, and the derivatives computed from them.

Source: Beard & McLain 2012, section 5.5 (dimensional derivatives) and eq. 3.13 (products of inertia).
"""

import tomllib
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path

from fleet.airframes.airframe import servo_parameters
from fleet.frames import G

RHO = 1.225  # air at sea level [kg/m3]
GENERIC = "small_fixed_wing"
_THRUST_LAPSE = 2.5  # thrust lapse of a fixed-pitch propeller, -(V / T) dT/dV at 0.7 of its zero-thrust J [-]
_HERE = Path(__file__).parent
_NUMBERS = ("mass", "J_x", "J_y", "J_z", "J_xz", "S", "b", "c", "speed", "thrust", "doubt")
_POSITIVE = ("mass", "J_x", "J_y", "J_z", "S", "b", "c", "speed", "doubt")
_THROWS = ("delta_a", "delta_e", "delta_r")
_COEFFICIENTS = (
    *("C_L_0", "C_L_alpha", "C_L_q", "C_L_delta_e", "C_D_0", "C_D_k", "C_m_alpha", "C_m_q", "C_m_delta_e"),
    *("C_Y_beta", "C_Y_p", "C_Y_r", "C_Y_delta_a", "C_Y_delta_r"),
    *("C_l_beta", "C_l_p", "C_l_r", "C_l_delta_a", "C_l_delta_r"),
    *("C_n_beta", "C_n_p", "C_n_r", "C_n_delta_a", "C_n_delta_r"),
)


@dataclass(frozen=True)
class Airframe:
    """One aircraft type.

    Attributes:
        name, source: of the airframe, and of its numbers
        value: mass [kg], J_x J_y J_z J_xz [kg m2], S [m2], b c [m], speed [m/s], thrust [m/s2], doubt [-]
        throw: deflection at full command, signs of Beard & McLain [rad]
        coefficient: per rad or per normalised rate [-]
        scale: True: the numbers describe a class and are scaled to the actual aircraft
        span: of the actual aircraft, where known [m]
        servo_params: servo map as SERVOn_* parameters, which replaces that of the autopilot; empty: none given
    """

    name: str
    source: str
    value: dict[str, float]
    throw: dict[str, float]
    coefficient: dict[str, float]
    scale: bool
    span: float | None = None
    servo_params: dict[str, float] = field(default_factory=dict)


def load(name_or_path: str) -> Airframe:
    """Read an airframe by the name of a file shipped with ParaUAV, or by a path.

    Raises:
        ValueError: when it is not an airframe; the text names the field to correct.
        OSError: when there is no such file.
    """
    path = _HERE / f"{name_or_path}.toml"
    path = path if "/" not in name_or_path and path.exists() else Path(name_or_path)
    if not path.exists():
        known = ", ".join(sorted(file.stem for file in _HERE.glob("*.toml")))
        raise OSError(f"{name_or_path}: found no airframe, expected a TOML file or one of {known}; check the path")
    try:
        document = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path.name}: found invalid TOML ({error}), expected an airframe; correct it") from None
    value = _numbers(path.name, document, _NUMBERS)
    for name in _POSITIVE:
        if value[name] <= 0:
            raise ValueError(f"{path.name}: found {name} = {value[name]:g}, expected more than 0; correct it")
    if value["J_x"] * value["J_z"] <= value["J_xz"] ** 2:
        raise ValueError(f"{path.name}: found J_xz = {value['J_xz']:g}, expected less than sqrt(J_x J_z); correct it")
    throw = _numbers(path.name, document.get("throw", {}), _THROWS)
    coefficient = _numbers(path.name, document.get("coefficients", {}), _COEFFICIENTS)
    airframe_name = str(document.get("name", path.stem))
    span = _numbers(path.name, document, ("span",))["span"] if "span" in document else None
    source, scale = str(document.get("source", "")), bool(document.get("scale", False))
    servo_params = servo_parameters(path.name, document["servo"]) if "servo" in document else {}
    return Airframe(airframe_name, source, value, throw, coefficient, scale, span, servo_params)


def _numbers(file: str, table: object, names: tuple[str, ...]) -> dict[str, float]:
    values = table if isinstance(table, dict) else {}
    for name in names:
        value = values.get(name)
        if not isinstance(value, int | float) or isinstance(value, bool) or not isfinite(value):
            raise ValueError(f"{file}: found {name} = {value!r}, expected a number; correct it")
    return {name: float(values[name]) for name in names}


def derivatives(airframe: Airframe, V: float) -> dict[str, float]:
    """Return the dimensional derivatives at airspeed V in level flight, by their names in `fleet.physics.wrench`.

    Specific force [m/s2] and angular acceleration [rad/s2] per m/s, rad/s and full command; without offsets.
    Body axes at a small angle of attack: lift along -z, drag and thrust lapse along -x.
    """
    a, k, t = airframe.value, airframe.coefficient, airframe.throw
    pressure = 0.5 * RHO * V * V * a["S"]
    lift = a["mass"] * G / pressure
    drag = k["C_D_0"] + k["C_D_k"] * lift**2
    force, span, chord = pressure / a["mass"], a["b"] / (2 * V), a["c"] / (2 * V)
    pitch = pressure * a["c"] / a["J_y"]
    out = {
        "X_u": -(2 + _THRUST_LAPSE) * force * drag / V,  # thrust equals drag in level flight
        "X_w": force * (lift - 2 * k["C_D_k"] * lift * k["C_L_alpha"]) / V,
        "X_de": 0.0,
        "X_dt": a["thrust"],
        "X_ww": force * k["C_L_alpha"] / V**2,
        "Z_u": 0.0,
        "Z_w": -force * (k["C_L_alpha"] + drag) / V,
        "Z_q": -force * k["C_L_q"] * chord,
        "Z_de": -force * k["C_L_delta_e"] * t["delta_e"],
        "M_u": 0.0,
        "M_w": pitch * k["C_m_alpha"] / V,
        "M_q": pitch * k["C_m_q"] * chord,
        "M_de": pitch * k["C_m_delta_e"] * t["delta_e"],
        "M_dt": 0.0,
    }
    lateral_terms = {"v": ("beta", 1 / V), "p": ("p", span), "r": ("r", span)}
    lateral_terms |= {"da": ("delta_a", t["delta_a"]), "dr": ("delta_r", t["delta_r"])}
    gamma = a["J_x"] * a["J_z"] - a["J_xz"] ** 2
    roll = pressure * a["b"] / gamma
    for short, (name, factor) in lateral_terms.items():
        l, n = k[f"C_l_{name}"], k[f"C_n_{name}"]
        out[f"Y_{short}"] = force * k[f"C_Y_{name}"] * factor
        out[f"L_{short}"] = roll * (a["J_z"] * l + a["J_xz"] * n) * factor
        out[f"N_{short}"] = roll * (a["J_xz"] * l + a["J_x"] * n) * factor
    return out
