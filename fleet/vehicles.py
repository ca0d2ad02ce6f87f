"""Vehicle classes: what an aircraft of each type can do, and therefore which models apply to it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class VehicleClass:
    """One vehicle class.

    Attributes:
        name: vehicle type as in `Status`
        has_wings: flies on wings; the fixed-wing models apply
        can_hover: flies on rotors; the multirotor model applies
        rotor_prefix: prefix of the autopilot parameters that limit flight on rotors
    """

    name: str
    has_wings: bool = False
    can_hover: bool = False
    rotor_prefix: str = ""

    @property
    def is_rotorcraft(self) -> bool:
        """Return whether it flies on rotors only."""
        return self.can_hover and not self.has_wings

    @property
    def is_vtol(self) -> bool:
        """Return whether it flies on wings and on rotors."""
        return self.can_hover and self.has_wings


FIXED_WING, MULTIROTOR, HELICOPTER, QUADPLANE, UNKNOWN = (
    "fixed_wing",
    "multirotor",
    "helicopter",
    "quadplane",
    "unknown",
)
_CLASSES = {
    one.name: one
    for one in (
        VehicleClass(FIXED_WING, has_wings=True),
        VehicleClass(MULTIROTOR, can_hover=True),
        VehicleClass(HELICOPTER, can_hover=True),
        VehicleClass(QUADPLANE, has_wings=True, can_hover=True, rotor_prefix="Q_"),
    )
}


def vehicle_class(name: str) -> VehicleClass:
    """Return the class of a vehicle type; a type without a class neither has wings nor hovers."""
    return _CLASSES.get(name) or VehicleClass(name)
