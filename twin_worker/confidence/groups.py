"""Groups of predictions that share a calibration table: method / law / airframe / parameters, and parent groups."""

ANY = "*"
_FAMILY = dict.fromkeys(("hybrid", "both", "dynamics"), "route")  # selected in flight; they share one ensemble
_FAST_SPEED = (
    40.0  # usual speed above which a fixed wing forms a class of its own; well above small ones in tailwind [m/s]
)


def group_name(method: str, law: str, airframe: str, parameters: str) -> str:
    """Return the group name of a prediction, e.g. hybrid/arduplane/fixed_wing/known.

    Args:
        method: as in `Prediction`
        law: controller twin, e.g. arduplane: L1 + TECS; only the part before the colon is used
        airframe: class of aircraft, from `airframe_class`
        parameters: known, identified or absent
    """
    parts = (method, law.partition(":")[0], airframe, parameters)
    return "/".join(part.strip().replace("/", " ") or "none" for part in parts)


def airframe_class(vehicle: str, speed: float) -> str:
    """Return the class of an aircraft by vehicle type and usual speed [m/s], e.g. fixed_wing_fast."""
    return f"{vehicle}_fast" if vehicle == "fixed_wing" and speed > _FAST_SPEED else vehicle


def group_chain(group: str) -> tuple[str, ...]:
    """Return a group and its parent groups, narrowest first: any method of its family, airframe, parameters, law.

    The airframe is dropped first and the law last: they affect errors least and most.
    """
    method, *rest = [*group.split("/"), *[ANY] * 4][:4]
    family = [_FAMILY.get(method, method), *rest]
    field_sets = ((0, 1, 2, 3), (0, 1, 3), (0, 1), (0,))
    chain = ["/".join(part if i in fields else ANY for i, part in enumerate(family)) for fields in field_sets]
    return tuple(dict.fromkeys(["/".join([method, *rest]), *chain]))


def group_setting(group: str) -> str:
    """Return the group name without the method: law / airframe / parameters."""
    return group.partition("/")[2]
