"""Build the published model: the newest verdict, and the active model with its data basis."""

import numpy as np

from fleet.contract import Array, Derivatives, Linear, Model
from fleet.physics.actuators import TAU
from fleet.physics.wrench import NAMES
from fleet.window import Window
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.linearise import linearise
from twin_worker.twin.state.state import Twin

EARNED_S = 10.0  # look-ahead of the published shrinkage weights [s]
_TOLD = 0.5  # reduction of the prior variance above which a parameter counts as determined by the data [-]


def model_message(twin: Twin, window: Window) -> Model:
    """Build the message with the newest verdict and the active model; a failed identification is never published."""
    plant, derivatives = twin.plant, None
    axes: tuple[Linear | None, Linear | None] = (None, None)
    if isinstance(plant, Coupled):
        axes, derivatives = linearise(plant, window), derivatives_of(plant, twin.airframe.name)
    elif plant is not None:
        axes = plant[0].linear(), plant[1].linear()
    return Model(
        uav=twin.uav,
        t=float(window.t[-1]),
        method=twin.method,
        verdict=twin.verdict,
        in_force=twin.in_force,
        longitudinal=axes[0],
        lateral=axes[1],
        derivatives=derivatives,
        earned=twin.earned.at(EARNED_S) if derivatives else {},
        window_t0=float(window.t[0]),
        window_s=window.seconds,
        interpolated=float(window.filled.mean()),
        wind_n=float(twin.wind.wind[0]),
        wind_e=float(twin.wind.wind[1]),
        extended=str(twin.extended or ""),
    )


def derivatives_of(plant: Coupled, airframe: str) -> Derivatives:
    """Return the parameters with their covariance, and the share of each determined by the data."""
    covariance = plant.covariance
    held = np.linalg.inv(plant.precision)
    told = 1.0 - np.diag(covariance) / np.diag(held)
    return Derivatives(
        names=NAMES,
        value=Array.of(plant.par, "<f8"),
        covariance=Array.of(covariance),
        told=Array.of(np.clip(told, 0.0, 1.0)),
        U0=float(plant.at[0]),
        W0=float(plant.at[1]),
        tau_s=Array.of(TAU),
        prior=airframe,
        window_t0=plant.t0,
        window_s=plant.t1 - plant.t0,
        sentence=_said(told, airframe),
    )


def _said(told: np.ndarray, airframe: str) -> str:
    """Describe which parameters come from the data and which from the prior."""
    by_data = int((told > _TOLD).sum())
    held = [name for name, share in zip(NAMES, told, strict=True) if share <= _TOLD]
    frozen = f"; from the prior: {' '.join(held)}" if held else ""
    return f"{by_data} of {len(NAMES)} parameters determined by the data, prior {airframe}{frozen}"
