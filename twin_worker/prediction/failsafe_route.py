"""Routes after a link loss: append the route of each failsafe mode, and schedule the change in the controller state."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fleet.autopilots.control_law import NEXT_LEG, NEXT_S, SWITCH_LEG, SWITCH_S
from fleet.autopilots.failsafe import FailsafeStep, describe_steps
from fleet.mission import Route

_COURSE_S = 0.5  # flight before the change that gives the course [s]
_MIN_SWITCH_S = 1e-3  # a change that is due at once [s]
PositionAt = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray | None]
"""(controller state, legs, look-ahead times (k,) [s]) -> positions, NED, (k, 3) [m]."""


@dataclass(frozen=True)
class FailsafePlan:
    """Mode changes after a link loss.

    Attributes:
        steps: in time order, at most two
        route_of: route of a mode that is entered at a position, NED (3,) [m], with a course [rad]; None: not known
        sentence: what is assumed beside the steps
        lost_t: newest telemetry, from which the times of the steps count [s since 1970]; -inf: the start
    """

    steps: tuple[FailsafeStep, ...]
    route_of: Callable[[str, np.ndarray, float], Route | None]
    sentence: str = ""
    lost_t: float = -np.inf

    def steps_from(self, t: float) -> tuple[FailsafeStep, ...]:
        """Return the steps with times from `t` on: a rollout begins before the newest row of telemetry."""
        delay = max(self.lost_t - t, 0.0)
        return tuple(step._replace(after_s=step.after_s + delay) for step in self.steps)


def with_failsafe(
    ctl: np.ndarray, legs: np.ndarray, plan: FailsafePlan, position_at: PositionAt, t: float
) -> tuple[np.ndarray, np.ndarray, str, float]:
    """Append the routes of a plan to the present route.

    Args:
        ctl, legs: state of the controller at the loss, and its route
        plan: mode changes
        position_at: predicts where the aircraft is at a change
        t: time of that state [s since 1970]
    Returns:
        state with the scheduled changes, all legs, a description of what is followed, and the look-ahead from `t` at
        which a route begins that is not known; inf: all are [s]
    """
    scheduled: list[FailsafeStep] = []
    for step, described in zip(plan.steps_from(t), plan.steps, strict=True):
        path = position_at(ctl, legs, step.after_s + np.array([-_COURSE_S, 0.0]).clip(-step.after_s))
        route = None
        if path is not None and np.isfinite(path).all():
            moved = path[1] - path[0]
            route = plan.route_of(step.mode, path[1], float(np.arctan2(moved[1], moved[0])))
        if route is None or not len(route.legs):
            text = describe_steps((*plan.steps[: len(scheduled)], described))
            return ctl, legs, f"{text}, whose path is not predicted", step.after_s
        # the separator keeps the new route from being a continuation of the last leg
        ctl, first = ctl.copy(), len(legs) + 1
        legs = np.vstack([legs, legs[-1:], route.legs])
        if scheduled:
            ctl[NEXT_S], ctl[NEXT_LEG] = max(step.after_s - scheduled[-1].after_s, _MIN_SWITCH_S), first
        else:
            ctl[SWITCH_S], ctl[SWITCH_LEG] = max(step.after_s, _MIN_SWITCH_S), first
        scheduled.append(step)
    return ctl, legs, " ".join(filter(None, (describe_steps(plan.steps), plan.sentence))), np.inf
