"""Public identification packages behind one face: identify(x, u, dt, axis) -> forecast(u), kstep(y, u, k).

Every peer gets the window standardised, without inputs that stand still or repeat another, and chooses its order on the
window's last quarter where that helps it. Whatever it throws, even SystemExit, is a failed axis; the other axis counts.
"""

import contextlib
import importlib.util
import io
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from typing import Any, Protocol

import numpy as np
import scipy.linalg

from fleet.window import STATES

from . import octave
from .flight import AXES, INPUT_COLUMNS, STATE_COLUMNS, Flight
from .sparse import polynomial
from .statespace import StateSpace, assembled, chosen

_BLOCK_ROWS = 12
_STILL, _ALIKE = 1e-7, 0.9999  # deviation of an input that stands still [-], correlation of two that are the same


class AxisModel(Protocol):
    """One axis, identified in standardised units."""

    ms: float

    def forecast(self, u: np.ndarray) -> np.ndarray: ...

    def kstep(self, y: np.ndarray, u: np.ndarray, k: int) -> np.ndarray: ...


Identify = Callable[[np.ndarray, np.ndarray, float, str], AxisModel]


# --- one small function per package ----------------------------------------------------------------------------------


def orders(axis: str) -> tuple[int, ...]:
    """Give the orders worth a try. Laterally that is the number of states: a choice cost every peer, when tried."""
    n = len(AXES[axis])
    return (n - 1, n, n + 2, 2 * n) if axis == "lon" else (n,)


def nfoursid(x: np.ndarray, u: np.ndarray, dt: float, axis: str) -> StateSpace:
    import pandas
    from nfoursid.nfoursid import NFourSID

    def fit(y: np.ndarray, u: np.ndarray, dt: float, order: int) -> StateSpace:
        outputs, inputs = ([f"{letter}{i}" for i in range(z.shape[1])] for letter, z in (("y", y), ("u", u)))
        frame = pandas.DataFrame(np.hstack([y, u]), columns=outputs + inputs)
        package = NFourSID(frame, outputs, inputs, num_block_rows=_BLOCK_ROWS)
        package.subspace_identification()
        found, noise = package.system_identification(rank=order)
        l = y.shape[1]
        K = _kalman(found.a, found.c, noise[l:, l:], noise[:l, :l], noise[l:, :l])
        return assembled((found.a, found.b, found.c, found.d, K), y, u, dt)

    return chosen(fit, orders(axis), x, u, dt)


def _kalman(A: np.ndarray, C: np.ndarray, Q: np.ndarray, R: np.ndarray, S: np.ndarray) -> np.ndarray | None:
    try:
        P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R, s=S)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return (A @ P @ C.T + S) @ np.linalg.inv(C @ P @ C.T + R)


def sippy(x: np.ndarray, u: np.ndarray, dt: float, axis: str, *, method: str) -> StateSpace:
    from sippy_unipi import system_identification

    def fit(y: np.ndarray, u: np.ndarray, dt: float, order: int) -> StateSpace:
        rows = {"SS_f": _BLOCK_ROWS, "SS_p": _BLOCK_ROWS}
        found = system_identification(y.T, u.T, method, SS_fixed_order=order, tsample=dt, **rows)
        return assembled((found.A, found.B, found.C, found.D, found.K), y, u, dt)

    return chosen(fit, orders(axis), x, u, dt)


def jax_sysid(x: np.ndarray, u: np.ndarray, dt: float, axis: str) -> StateSpace:
    os.environ.setdefault("JAX_ENABLE_X64", "1")
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    from jax_sysid.models import LinearModel

    def fit(y: np.ndarray, u: np.ndarray, dt: float, order: int) -> StateSpace:
        model = LinearModel(order, y.shape[1], u.shape[1], feedthrough=False, y_in_x=False, seed=0, Ts=dt)
        model.loss(rho_x0=1e-4, rho_th=1e-4)
        model.optimization(adam_epochs=300, lbfgs_epochs=500, iprint=-1)
        model.fit(y, u)
        A, B, C, D = model.ssdata()
        return assembled((A, B, C, D, None), y, u, dt)

    return chosen(fit, (len(AXES[axis]),), x, u, dt)  # a second for each fit: no trials


def pysindy(x: np.ndarray, u: np.ndarray, dt: float, axis: str) -> Any:
    return chosen(polynomial, [(1, 0.01), (1, 0.05), (1, 0.2), (2, 0.05), (2, 0.2)], x, u, dt)


def moen4(x: np.ndarray, u: np.ndarray, dt: float, axis: str, *, running: octave.Octave) -> StateSpace:
    def fit(y: np.ndarray, u: np.ndarray, dt: float, order: int) -> StateSpace:
        found = running.moen4(y, u, dt, order)
        model = assembled((found[name] for name in "ABCDK"), y, u, dt)
        model.ms = float(found["ms"].squeeze())
        return model

    return chosen(fit, orders(axis), x, u, dt)


PEERS: dict[str, tuple[str, Callable[[], Identify]]] = {  # key: package, how to get its function
    "nfoursid": ("nfoursid", lambda: nfoursid),
    "sippy_unipi_n4sid": ("sippy_unipi", lambda: partial(sippy, method="N4SID")),
    "sippy_unipi_moesp": ("sippy_unipi", lambda: partial(sippy, method="MOESP")),
    "sippy_unipi_cva": ("sippy_unipi", lambda: partial(sippy, method="CVA")),
    "jax-sysid": ("jax_sysid", lambda: jax_sysid),
    "pysindy": ("pysindy", lambda: pysindy),
    "moen4": ("", lambda: partial(moen4, running=octave.Octave())),
}


def absent() -> dict[str, str]:
    """Say which peers are not there, and why, by their keys."""
    found = {}
    for key, (package, _) in PEERS.items():
        if package and importlib.util.find_spec(package) is None:
            found[key] = f"found no package {package}; make bench-setup; skipped"
        elif not package and (why := octave.absent()):
            found[key] = why
    return found


def versions(wanted: list[str]) -> dict[str, str]:
    """Give the versions of the packages behind the wanted peers."""
    return {name: version(name) for key in wanted if key in PEERS and (name := PEERS[key][0])}


# --- both axes at once -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Standard:
    """How one axis is laid before a peer: which inputs, and what is taken off and divided by."""

    inputs: list[int]
    y_mean: np.ndarray
    y_scale: np.ndarray
    u_mean: np.ndarray
    u_scale: np.ndarray

    def y(self, flight: Flight, axis: str) -> np.ndarray:
        return (flight.x[:, STATE_COLUMNS[axis]] - self.y_mean) / self.y_scale

    def u(self, u: np.ndarray) -> np.ndarray:
        return (u[:, self.inputs] - self.u_mean) / self.u_scale


def standard(flight: Flight, axis: str) -> Standard:
    """Find what standardises one axis of a window; inputs that stand still or repeat another are left out."""
    x = flight.x[:, STATE_COLUMNS[axis]]
    kept: list[int] = []
    for column in INPUT_COLUMNS[axis]:
        u = flight.u[:, column]
        alike = any(abs(np.corrcoef(u, flight.u[:, other])[0, 1]) > _ALIKE for other in kept if u.std() > _STILL)
        if u.std() > _STILL and not alike:
            kept.append(column)
    kept = kept or INPUT_COLUMNS[axis][:1]
    u = flight.u[:, kept]
    return Standard(kept, x.mean(axis=0), x.std(axis=0) + 1e-9, u.mean(axis=0), u.std(axis=0) + 1e-9)


@dataclass(frozen=True)
class Both:
    """Both axes of one window; an axis that failed says nan."""

    axes: dict[str, tuple[Standard, AxisModel]]
    trouble: list[str]

    @property
    def ms(self) -> float:
        """Give the processor time of both identifications [ms]."""
        return sum(model.ms for _, model in self.axes.values())

    def forecast(self, known: Flight, u: np.ndarray) -> np.ndarray:
        out = np.full((len(u), len(STATES)), np.nan)
        for axis, (like, model) in self.axes.items():
            out[:, STATE_COLUMNS[axis]] = model.forecast(like.u(u)) * like.y_scale + like.y_mean
        return out

    def kstep(self, flight: Flight, k: int) -> np.ndarray:
        out = np.full((len(flight) - k, len(STATES)), np.nan)
        for axis, (like, model) in self.axes.items():
            told = model.kstep(like.y(flight, axis), like.u(flight.u), k)
            out[:, STATE_COLUMNS[axis]] = told * like.y_scale + like.y_mean
        return out


class Peer:
    """One peer on one flight; it remembers nothing from window to window."""

    def __init__(self, identify: Identify) -> None:
        self._identify = identify

    def identify(self, known: Flight, start: int) -> Both:
        window = known.part(start, len(known))
        axes, trouble = {}, []
        for axis in AXES:
            like = standard(window, axis)
            try:
                with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                    warnings.simplefilter("ignore")
                    axes[axis] = like, self._identify(like.y(window, axis), like.u(window.u), window.dt, axis)
            except (Exception, SystemExit) as error:
                trouble.append(f"{axis}: {type(error).__name__}: {error}")
        return Both(axes, trouble)


def method(key: str) -> Callable[[], Peer]:
    """Give what makes the peer of this key anew for every flight; one Octave serves all of them."""
    identify = PEERS[key][1]()
    return lambda: Peer(identify)
