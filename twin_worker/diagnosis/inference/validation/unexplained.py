"""Describe an unknown mismatch: its time segments, and a sparse free-form fit without physical meaning."""

import numpy as np

from twin_worker.diagnosis.data.fault_hypothesis import FaultHypothesis
from twin_worker.diagnosis.model.residual import ModelledFlight

_MIN_LEVEL = 2.0  # rms over 5 s from which a segment is listed [standard deviations]
_WINDOW = 25  # rows of 5 s
_TERMS = 2  # of the free-form fit


def high_segments(t: np.ndarray, e: np.ndarray, ok: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Return the segments where the rms of a whitened residual, (n,), is high [s]."""
    power = np.where(ok, np.nan_to_num(e) ** 2, 0.0)
    weight = np.convolve(ok.astype(float), np.ones(_WINDOW), "same")
    level = np.sqrt(np.convolve(power, np.ones(_WINDOW), "same") / np.maximum(weight, 1.0))
    exceeds = np.concatenate([[False], level > min(_MIN_LEVEL, 0.9 * level.max()), [False]])
    edges = np.flatnonzero(np.diff(exceeds.astype(int)))
    return tuple((float(t[a]), float(t[min(b, len(t) - 1)])) for a, b in zip(edges[::2], edges[1::2], strict=True))


def free_form(modelled: ModelledFlight, weather: tuple[FaultHypothesis, ...], channel: int) -> dict[str, float]:
    """Fit the residual of a channel by the library terms that explain most, `term -> coefficient`.

    Source: Brunton, Proctor & Kutz 2016 (sparse regression), here by orthogonal matching pursuit.
    """
    flow = modelled.equation_terms(weather).flow
    y = modelled.residuals(weather)[modelled.ok, channel]
    d_a, d_e, d_r, d_t = modelled.inputs(weather)
    library = {
        "1": np.ones_like(flow.Va),
        "Va": flow.Va / modelled.base.speed,
        "alpha": flow.alpha,
        "beta": flow.beta,
        "|beta|": np.abs(flow.beta),
        "p": flow.p,
        "q": flow.q,
        "r": flow.r,
        "delta_a": d_a,
        "delta_e": d_e,
        "delta_r": d_r,
        "delta_t": d_t,
        "height": flow.height / 100.0,
    }
    columns = {name: x[modelled.ok] for name, x in library.items()}
    chosen: list[str] = []
    remainder = y
    for _ in range(_TERMS):
        correlation = {
            n: abs(x @ remainder) / (np.linalg.norm(x) + 1e-12) for n, x in columns.items() if n not in chosen
        }
        chosen.append(max(correlation, key=lambda name: correlation[name]))
        A = np.stack([columns[name] for name in chosen], axis=1)
        coefficients = np.linalg.lstsq(A, y, rcond=None)[0]
        remainder = y - A @ coefficients
    return {name: float(x) for name, x in zip(chosen, coefficients, strict=True)}
