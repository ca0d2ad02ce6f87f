"""Instrumented aircraft files: airframe faults become JSBSim properties.

The installed files are read and changed in memory only. At the defaults of the properties the aircraft is unchanged,
except that the inertial unit of the Cessna moves from the eye point to the centre of gravity.

    conceal/C_D         drag coefficient added                      conceal/lift    factor of all lift
    conceal/C_n_beta, C_Y_beta, C_l_p, C_m_q    factors of those derivatives (c172p; small: vary/*)
    conceal/slipstream  fraction of the propeller slipstream on the tail surfaces (c172p; 1 as in JSBSim)
    conceal/p_factor    shift of the thrust line per angle of attack (c172p) [in/rad]
    and a further point mass at the empty centre of gravity, the last in the list
"""

from functools import cache
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from fleet.simulator.vehicle.jsbsim import model_file
from fleet.simulator.vehicle.types import TYPES, AircraftType

_FACTORS = {  # property: functions it multiplies
    "conceal/C_n_beta": ("aero/coefficient/Cnb",),
    "conceal/C_Y_beta": ("aero/coefficient/CYb",),
    "conceal/C_l_p": ("aero/coefficient/Clp",),
    "conceal/C_m_q": ("aero/coefficient/Cmq",),
}
_IMU_POSITION_IN = (41.9, -0.7, 37.3)
_INDUCED_PRESSURE = "aero/function/qbar-induced-psf"
_TAIL_FUNCTIONS = ("aero/coefficient/Cmde", "aero/coefficient/Cndr")
_P_FACTOR = {"z": ("-1", "aero/alpha-rad"), "y": ("1", "aero/beta-rad")}  # thrust line to the right: nose left


def instrumented_type(name: str) -> AircraftType:
    """Return the type `name` of `types.TYPES` with its instrumented aircraft file."""
    return TYPES[name]._replace(xml=_aircraft_xml(name))


@cache
def _aircraft_xml(name: str) -> str:
    """Return the instrumented aircraft file of one type."""
    kind = TYPES[name]
    root = ElementTree.parse(model_file(kind)).getroot()
    _add_force_knobs(root)
    if kind.from_jsbsim:
        _move_imu_to_cg(root)
        _add_derivative_knobs(root)
        _add_propeller_knobs(root)
    return ElementTree.tostring(root, encoding="unicode")


def _add_force_knobs(root: Element) -> None:
    """Add properties for drag, lift and mass."""
    air = _find_one(root, "aerodynamics")
    for knob, value in (("conceal/C_D", "0"), ("conceal/lift", "1")):
        air.insert(0, _property(knob, value))
    for function in _find_one(air, "axis[@name='LIFT']").findall("function"):
        SubElement(_find_one(function, "product"), "property").text = "conceal/lift"
    drag = SubElement(_find_one(air, "axis[@name='DRAG']"), "function", name="conceal/drag")
    _product(drag, "aero/qbar-psf", "metrics/Sw-sqft", "conceal/C_D")
    balance = _find_one(root, "mass_balance")
    mass = SubElement(balance, "pointmass", name="concealed")
    SubElement(mass, "weight", unit="LBS").text = "0"
    mass.append(_find_one(balance, "location[@name='CG']"))


def _move_imu_to_cg(root: Element) -> None:
    """Move the eye point, where JSBSim computes accelerations, to the centre of gravity of the loaded Cessna."""
    eyepoint = _find_one(root, "metrics/location[@name='EYEPOINT']")
    for axis, inches in zip("xyz", _IMU_POSITION_IN, strict=True):
        _find_one(eyepoint, axis).text = str(inches)


def _add_derivative_knobs(root: Element) -> None:
    air = _find_one(root, "aerodynamics")
    for knob, names in _FACTORS.items():
        air.insert(0, _property(knob, "1"))
        for name in names:
            SubElement(_find_one(air, f".//function[@name='{name}']/product"), "property").text = knob


def _add_propeller_knobs(root: Element) -> None:
    """Add properties for the slipstream on the tail and for the shift of the thrust line."""
    air = _find_one(root, "aerodynamics")
    tail_pressure = Element("function", name="conceal/qbar-tail-psf")
    total = SubElement(tail_pressure, "sum")
    SubElement(total, "property").text = "aero/qbar-psf"
    induced = SubElement(total, "product")
    SubElement(induced, "property").text = "conceal/slipstream"
    difference = SubElement(induced, "difference")
    for name in (_INDUCED_PRESSURE, "aero/qbar-psf"):
        SubElement(difference, "property").text = name
    air.insert(list(air).index(_find_one(air, f"function[@name='{_INDUCED_PRESSURE}']")) + 1, tail_pressure)
    air.insert(0, _property("conceal/slipstream", "1"))
    for name in _TAIL_FUNCTIONS:
        for element in air.findall(f".//function[@name='{name}']/product/property"):
            element.text = "conceal/qbar-tail-psf" if element.text == _INDUCED_PRESSURE else element.text
    reactions = Element("external_reactions")
    reactions.append(_property("conceal/p_factor", "0"))
    for axis, (sign, angle) in _P_FACTOR.items():
        moment = SubElement(reactions, "moment", name=f"p-factor-{axis}", frame="BODY")
        arm = _product(SubElement(moment, "function"), "propulsion/engine/thrust-lbs", "conceal/p_factor", angle)
        SubElement(arm, "value").text = str(1 / 12)
        direction = SubElement(moment, "direction")
        for name in "xyz":
            SubElement(direction, name).text = sign if name == axis else "0"
    root.insert(list(root).index(air), reactions)


def _find_one(root: Element, path: str) -> Element:
    element = root.find(path)
    if element is None:
        raise RuntimeError(f"jsbsim: found no {path} in its aircraft file, expected one; install JSBSim 1.3")
    return element


def _property(name: str, value: str) -> Element:
    knob = Element("property", value=value)
    knob.text = name
    return knob


def _product(parent: Element, *names: str) -> Element:
    product = SubElement(parent, "product")
    for name in names:
        SubElement(product, "property").text = name
    return product
