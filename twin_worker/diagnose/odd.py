"""Is anything left that no effect of the catalogue explains: has an equation itself changed, since any instant?

For each channel every coefficient of its equation is let go at once, and the channel's own slow and fast terms beside
it. A named effect that is right leaves nothing to gain; one that only resembles what happened leaves much.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from fleet.effects import Onset
from twin_worker.diagnose.baseline import CHANNELS, SHOWN_BY, Baseline
from twin_worker.diagnose.residual import Terms
from twin_worker.diagnose.scan import PRICE, WELL, gates_of, normals, solved
from twin_worker.diagnose.sight import Sight
from twin_worker.diagnose.smooth import STEP_S

_LEAST, _CHANCE = 300.0, 2.0  # gain; over what nominal flights reach by chance
_AGAINST = 3.0  # and that many limits, to be held against names; and
_BESIDE, _BESIDE_LOUD = 0.5, 0.25  # so much of what they gained, less where some channel stays loud
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
    """Give what every channel would gain by changing since its best instant, best first, no nuisance handed over.

    Plain telemetry knows its equations too loosely to tell.
    """
    if not sight.base.vane:
        return []
    sight = sight.held()
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


def strange(odds: Sequence[Odd], base: Baseline, gained: float, loud: bool) -> Odd | None:
    """Give the first that names do not explain; `gained` by them in all, 0 without any; `loud`: a channel stays so."""
    least = (_BESIDE_LOUD if loud else _BESIDE) * gained
    limits = _AGAINST if gained else 1.0
    return next((odd for odd in odds if odd.worth > max(limits * odd.limit(base), least)), None)


def _terms(sight: Sight) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Give the terms that each channel may change by, (n,) each."""
    made = sight.case.terms(sight.granted)
    for equation, channel in SHOWN_BY.items():
        if sight.base.r2.get(equation, 1.0) > WELL:
            own = made.terms[equation] * made.scale.get(equation, 1.0)
            yield channel, [*own, *_more(channel, made)]
    flow = made.flow
    if "Va" in sight.case.flight.readings:
        slow = _lagged(flow.Va, _AIR_LAG_S) - flow.Va
        yield "airspeed", [np.ones_like(flow.Va), flow.Va, slow]
    for name, rate in (("gyro_roll", flow.p), ("gyro_pitch", flow.q), ("gyro_yaw", flow.r)):
        yield name, [np.ones_like(rate), rate]


def _more(channel: str, made: Terms) -> list[np.ndarray]:
    """Give what a channel may feel that no wing does: thrust, and loads that shift with the force on them."""
    f_x, f_y, _ = made.aside["f"]
    return {"force_x": list(made.terms["T"][:1]), "roll": [f_y], "pitch": [f_x]}.get(channel, [])


def _lagged(x: np.ndarray, tau: float) -> np.ndarray:
    """Give x, (n,), behind a first-order lag [s]."""
    kept = np.exp(-STEP_S / tau)
    out: np.ndarray = lfilter([1.0 - kept], [1.0, -kept], x, zi=[kept * x[0]])[0]
    return out
