"""The model as it is published: the newest verdict, and the plant in force with what it stands on."""

import numpy as np

from fleet.contract import Array, Derivatives, Linear, Model
from fleet.physics.actuators import TAU
from fleet.physics.wrench import NAMES
from fleet.window import Window
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.linearise import linearise
from twin_worker.twin.state.state import Twin

EARNED_S = 10.0  # look-ahead the published shares are for [s]
_TOLD = 0.5  # share of a parameter's prior variance that data must remove to have told it [-]


def model_message(twin: Twin, window: Window) -> Model:
    """Publish the newest verdict with the model in force: a failed identification never shows its numbers."""
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
    """Return the parameters with their covariance, and how much of each the data told."""
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
    """Say what the data identified and what the prior held."""
    by_data = int((told > _TOLD).sum())
    held = [name for name, share in zip(NAMES, told, strict=True) if share <= _TOLD]
    frozen = f"; held by the prior: {' '.join(held)}" if held else ""
    return f"{by_data} of {len(NAMES)} parameters told by the data, prior {airframe}{frozen}"
