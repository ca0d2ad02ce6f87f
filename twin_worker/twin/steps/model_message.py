"""Build the published model: the newest verdict, and the active model with its data basis."""

import numpy as np

from fleet.contract import Array, Derivatives, LinearModel, Model
from fleet.physics.simulate import TAU
from fleet.physics.wrench import NAMES
from fleet.window import Window
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.identification.fixed_wing.linearise import linearise
from twin_worker.twin.state.state import Twin

SHRINKAGE_LOOKAHEAD_S = 10.0  # look-ahead of the published shrinkage weights [s]
_MIN_DATA_SHARE = 0.5  # reduction of the prior variance above which a parameter counts as determined by the data [-]


def model_message(twin: Twin, window: Window) -> Model:
    """Build the message with the newest verdict and the active model; a failed identification is never published."""
    plant, derivatives = twin.models.active_model, None
    axes: tuple[LinearModel | None, LinearModel | None] = (None, None)
    if isinstance(plant, DerivativesModel):
        axes, derivatives = linearise(plant, window), derivatives_message(plant, twin.config.airframe.name)
    elif plant is not None:
        axes = plant[0].linear(), plant[1].linear()
    return Model(
        uav=twin.config.uav,
        t=float(window.t[-1]),
        method=twin.config.method,
        verdict=twin.identification.verdict,
        active_verdict=twin.models.active_verdict,
        longitudinal=axes[0],
        lateral=axes[1],
        derivatives=derivatives,
        shrinkage_weights=twin.identification.shrinkage.kappa_at(SHRINKAGE_LOOKAHEAD_S) if derivatives else {},
        window_t0=float(window.t[0]),
        window_s=window.seconds,
        interpolated=float(window.filled.mean()),
        wind_n=float(twin.environment.wind.wind[0]),
        wind_e=float(twin.environment.wind.wind[1]),
        active_effect=str(twin.models.active_effect or ""),
    )


def derivatives_message(plant: DerivativesModel, airframe: str) -> Derivatives:
    """Return the parameters with their covariance, and the share of each determined by the data."""
    covariance = plant.covariance
    prior_covariance = np.linalg.inv(plant.prior_precision)
    data_share = 1.0 - np.diag(covariance) / np.diag(prior_covariance)
    return Derivatives(
        names=NAMES,
        value=Array.of(plant.par, "<f8"),
        covariance=Array.of(covariance),
        variance_reduction=Array.of(np.clip(data_share, 0.0, 1.0)),
        U0=float(plant.trim_velocity[0]),
        W0=float(plant.trim_velocity[1]),
        tau_s=Array.of(TAU),
        prior=airframe,
        window_t0=plant.t0,
        window_s=plant.t1 - plant.t0,
        sentence=_describe(data_share, airframe),
    )


def _describe(data_share: np.ndarray, airframe: str) -> str:
    """Describe which parameters come from the data and which from the prior."""
    by_data = int((data_share > _MIN_DATA_SHARE).sum())
    from_prior = [name for name, share in zip(NAMES, data_share, strict=True) if share <= _MIN_DATA_SHARE]
    suffix = f"; from the prior: {' '.join(from_prior)}" if from_prior else ""
    return f"{by_data} of {len(NAMES)} parameters determined by the data, prior {airframe}{suffix}"
