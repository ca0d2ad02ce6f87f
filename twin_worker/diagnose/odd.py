"""Is anything left that no effect of the catalogue explains: has an equation itself changed, since any instant?

For each channel every coefficient of its equation is let go at once, and the channel's own slow and fast terms beside
it. A named effect that is right leaves nothing to gain; one that only resembles what happened leaves much.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from fleet.effects import Onset
from twin_worker.diagnose.baseline import CHANNELS, Baseline
from twin_worker.diagnose.residual import Terms
from twin_worker.diagnose.scan import PRICE, WELL, gates_of, normals, solved
from twin_worker.diagnose.sight import Sight
from twin_worker.diagnose.smooth import STEP_S

_EQUATION = {"roll": "L", "pitch": "M", "yaw": "N", "force_x": "X", "lift": "alpha", "side": "beta"}
_LEAST, _CHANCE = 300.0, 2.0  # gain; over what nominal flights reach by chance
_AIR_LAG_S = 4.0  # of a pressure line that is partly blocked


class Odd(NamedTuple):
    """What a changed equation would gain beyond its price, in which channel, since when [s]."""

    worth: float
    channel: str
    t0: float

    @property
    def kind(self) -> str:
        """Name it beside what nominal flights reach by chance."""
        return f"odd:{self.channel}"

    def limit(self, base: Baseline) -> float:
        """Give what it must gain to be more than chance."""
        return max(_LEAST, _CHANCE * base.chance.get(self.kind, 0.0))


def oddities(sight: Sight) -> list[Odd]:
    """Give what every channel would gain by changing since its best instant, best first."""
    rows, whens = gates_of(sight.case.t, Onset.STEP)
    out = []
    for channel, terms in _terms(sight):
        J = np.zeros((len(sight.case.t), len(CHANNELS), len(terms)))
        c = CHANNELS.index(channel)
        for k, x in enumerate(terms):
            J[:, c, k] = x / (np.std(x[sight.ok]) + 1e-12)
        white = np.stack([sight.noise.whiten(J[:, :, k]) for k in range(len(terms))], axis=2) * sight.ok[:, None, None]
        gain, _ = solved(sight, *normals(sight, white, rows, Onset.STEP))
        best = int(np.argmax(gain))
        out.append(Odd(float(gain[best]) - PRICE * len(terms), channel, whens[best].t0))
    return sorted(out, key=lambda one: -one.worth)


def _terms(sight: Sight) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Give the terms that each channel may change by, (n,) each."""
    made = sight.case.terms(sight.granted)
    for channel, equation in _EQUATION.items():
        if sight.base.r2.get(equation, 1.0) > WELL:
            own = made.terms[equation] * made.scale.get(equation, 1.0)
            yield channel, [*own, *_more(channel, made)]
    flow = made.flow
    if "Va" in sight.case.flight.readings:
        slow = _lagged(flow.Va, _AIR_LAG_S) - flow.Va
        yield "airspeed", [np.ones_like(flow.Va), flow.Va, slow]
    if sight.base.vane:
        for name, rate in (("gyro_roll", flow.p), ("gyro_pitch", flow.q), ("gyro_yaw", flow.r)):
            yield name, [np.ones_like(rate), rate]


def _more(channel: str, made: Terms) -> list[np.ndarray]:
    """Give what a channel may feel that no wing does: thrust, and loads that shift with the force on them."""
    f_x, f_y, _ = made.aside["f"]
    return {"force_x": list(made.terms["T"][:1]), "roll": [f_y], "pitch": [f_x]}.get(channel, [])


def _lagged(x: np.ndarray, tau: float) -> np.ndarray:
    """Give x, (n,), behind a first-order lag [s]."""
    out, share = x.copy(), 1.0 - np.exp(-STEP_S / tau)
    for k in range(1, len(x)):
        out[k] = out[k - 1] + share * (x[k] - out[k - 1])
    return out
