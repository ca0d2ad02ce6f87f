"""Groups of predictions that share a calibration table: method / law / airframe / parameters, and wider ones."""

from collections.abc import Iterator

ANY = "*"
_FAST = 35.0  # trim airspeed from which a winged aircraft is no small one [m/s]


def group_of(method: str, law: str, airframe: str, parameters: str) -> str:
    """Name the group of a prediction, e.g. hybrid/arduplane/fixed_wing/known.

    Args:
        method: as in `Prediction`
        law: controller twin, e.g. arduplane: L1 + TECS; what is before the colon counts
        airframe: class of aircraft, as `airframe_class` gives it
        parameters: known, identified or absent
    """
    parts = (method, law.partition(":")[0], airframe, parameters)
    return "/".join(part.strip().replace("/", " ") or "none" for part in parts)


def airframe_class(vehicle: str, speed: float) -> str:
    """Name the class of an aircraft by its kind and usual airspeed [m/s]: fixed_wing, fixed_wing_fast, multirotor …."""
    return f"{vehicle}_fast" if vehicle == "fixed_wing" and speed > _FAST else vehicle


def wider(group: str) -> Iterator[str]:
    """Give a group and those it belongs to, narrowest first: any airframe, any parameters, any law.

    Parameters matter more than the airframe, and the law more than either.
    """
    parts = [*group.split("/"), *[ANY] * 4][:4]
    for known in ((0, 1, 2, 3), (0, 1, 3), (0, 1), (0,)):
        yield "/".join(part if i in known else ANY for i, part in enumerate(parts))
