"""Groups of predictions that share a calibration table: method / law / airframe / parameters, and wider ones."""

ANY = "*"
_WAYS = dict.fromkeys(("hybrid", "both", "dynamics"), "route")  # chosen among in flight; one ensemble tells their doubt
_FAST = 40.0  # usual speed from which a winged aircraft is no small one; a tailwind is no other aircraft [m/s]


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
    """Name the class of an aircraft by its kind and usual speed [m/s]: fixed_wing, fixed_wing_fast, multirotor …."""
    return f"{vehicle}_fast" if vehicle == "fixed_wing" and speed > _FAST else vehicle


def wider(group: str) -> tuple[str, ...]:
    """Return a group and those it belongs to, narrowest first: any of its ways, any airframe, any parameters, any law.

    Parameters matter more than the airframe, and the law more than either.
    """
    method, *rest = [*group.split("/"), *[ANY] * 4][:4]
    way = [_WAYS.get(method, method), *rest]
    known = ((0, 1, 2, 3), (0, 1, 3), (0, 1), (0,))
    chain = ["/".join(part if i in of else ANY for i, part in enumerate(way)) for of in known]
    return tuple(dict.fromkeys(["/".join([method, *rest]), *chain]))


def setting(group: str) -> str:
    """Return what a group says besides the method: law / airframe / parameters."""
    return group.partition("/")[2]
