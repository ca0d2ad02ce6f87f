"""Every effect keeps the contract: nothing at zero, a slope or a start, known keys, honest undoing and telling."""

import importlib.util
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleet.effects import INCREMENTS, MEMORY, READINGS, Body, Effect, Flow, Stage, catalogue

ALL = catalogue("")
ROWS = 400
DT = 0.04
BODY = Body(mass=912.0, S=16.2, b=10.9, c=1.49, D=1.9, lag=0.1)
TOLD = {  # name -> what people want to be told, beside names with a single parameter of that name
    "wind_steady": {"speed_mps", "from_deg"},
    "gust_discrete": {"speed_mps", "from_deg"},
    "wind_shear": {"mps_per_100m", "from_deg"},
    "updraft": {"speed_mps"},
    "air_density": {"density_ratio"},
    "icing": {"lift_loss", "dCD", "dCm"},
    "mass_change": {"dmass_kg"},
    "cg_shift": {"dx_m"},
    "imu_misalignment": {"roll_deg", "pitch_deg", "yaw_deg"},
    "actuator_lag": {"tau_s"},
    "actuator_delay": {"delay_s"},
    "actuator_rate_limit": {"rate_per_s"},
    "actuator_deadband": {"half_width"},
    "actuator_offset": {"offset"},
    "control_effectiveness_loss": {"loss"},
    "airspeed_scale": {"scale"},
    "airspeed_bias": {"bias_mps"},
    "gps_latency": {"latency_s"},
    "gyro_bias": {"bias_dps"},
    "accel_bias": {"bias_mps2"},
    "heading_bias": {"bias_deg"},
    "baro_bias": {"bias_m"},
}


def of_stage(*stages: Stage) -> list[Any]:
    return [pytest.param(effect, id=name) for name, effect in ALL.items() if effect.stage in stages]


EVERY = pytest.mark.parametrize("effect", of_stage(*Stage))
SERVOS = pytest.mark.parametrize("effect", of_stage(Stage.DELTA))
SENSORS = pytest.mark.parametrize("effect", of_stage(Stage.SENSOR))
FLOWS = pytest.mark.parametrize("effect", of_stage(Stage.AIR, Stage.WRENCH, Stage.MASS))


def smooth(rng: np.random.Generator) -> np.ndarray:
    """Make a slow random series, (ROWS,), of about unit size."""
    t, rate = DT * np.arange(ROWS), rng.uniform(0.2, 1.5, 3)
    return np.sin(np.multiply.outer(t, rate) + rng.uniform(0.0, 6.0, 3)).sum(-1)


def flow() -> Flow:
    """Make a flight that climbs from the ground, beyond the stall and back: every effect has something to bite on."""
    rng = np.random.default_rng(1)
    series = {field.name: smooth(rng) for field in fields(Flow) if field.name != "body"}
    height = np.linspace(0.0, 300.0, ROWS)
    positive = {"Va": 40.0, "q_bar": 900.0, "T": 1500.0, "rho": 1.2}
    series |= {name: middle * (1.0 + 0.1 * series[name]) for name, middle in positive.items()}
    series |= {"t": DT * np.arange(ROWS), "h": height + 400.0, "height": height, "throttle_time": DT * np.arange(ROWS)}
    return Flow(**series | {"alpha": 0.1 + 0.1 * series["alpha"]}, body=BODY)


def at(whole: Flow, row: int) -> Flow:
    """Give one instant of it, in numbers."""
    numbers = {field.name: float(getattr(whole, field.name)[row]) for field in fields(Flow) if field.name != "body"}
    return replace(whole, **numbers)


def readings() -> dict[str, np.ndarray]:
    """Make what sensors say, smooth and of sizes seen in flight."""
    rng = np.random.default_rng(2)
    return {name: smooth(rng) for name in READINGS} | {"t": DT * np.arange(ROWS), "Va": 30.0 + smooth(rng)}


def commands() -> np.ndarray:
    """Make commands with slow, fast and extreme parts."""
    rng = np.random.default_rng(3)
    return np.clip(0.5 * smooth(rng) + 0.1 * rng.standard_normal(ROWS), -1.2, 1.2)


def served(effect: Effect, u: np.ndarray, par: np.ndarray, pieces: int = 1) -> np.ndarray:
    """Give what the servo does of commands, the series handed over in so many pieces."""
    out, memory = u.copy(), np.full(MEMORY, u[0])
    for rows in np.array_split(np.arange(len(u)), pieces):
        piece = out[rows]
        effect.act(piece, memory, DT, np.ascontiguousarray(par[:, rows]))
        out[rows] = piece
    return out


def variants(effect: Effect) -> list[dict[str, str]]:
    """List the keywords for everything it may befall."""
    return [{"of": one} for one in effect.targets] or [{}]


def outcome(effect: Effect, par: tuple[float, ...], **of: str) -> np.ndarray:
    """Stack all an effect says of the flight, (k, ROWS)."""
    if effect.stage is Stage.DELTA:
        return served(effect, commands(), np.repeat(np.array(par, float)[:, None], ROWS, 1))[None]
    said = effect.act(readings() if effect.stage is Stage.SENSOR else flow(), *par, **of)
    return np.stack([value + np.zeros(ROWS) for value in said.values()])


def kinds(effect: Effect) -> list[dict[str, str]]:
    """List the keywords `act` takes; the servos' are chosen by the engine."""
    return [{}] if effect.stage is Stage.DELTA else variants(effect)


# --- zero is nothing -------------------------------------------------------------------------------------------------


@FLOWS
def test_all_zero_adds_nothing_to_numbers_and_series(effect: Effect) -> None:
    whole = flow()
    for of in kinds(effect):
        for seen, zero in ((whole, 0.0), (whole, np.zeros(ROWS)), (at(whole, 7), 0.0)):
            said = effect.act(seen, *[zero] * effect.n_parameters, **of)
            assert said and all(np.all(np.asarray(value) == 0.0) for value in said.values())


@SENSORS
def test_all_zero_leaves_readings_bit_for_bit(effect: Effect) -> None:
    true = readings()
    for of in kinds(effect):
        for zero in (0.0, np.zeros(ROWS)):
            said = effect.act(true, *[zero] * effect.n_parameters, **of)
            assert said and all(np.array_equal(value, true[name]) for name, value in said.items())


@SERVOS
def test_all_zero_leaves_commands_bit_for_bit(effect: Effect) -> None:
    u = commands()
    assert np.abs(u).max() > 1.0  # beyond what any servo is asked for
    assert np.array_equal(served(effect, u, np.zeros((effect.n_parameters, ROWS))), u)


# --- away from zero --------------------------------------------------------------------------------------------------


@EVERY
def test_each_parameter_has_a_slope_at_zero_or_the_effect_says_where_to_start(effect: Effect) -> None:
    zero = (0.0,) * effect.n_parameters
    for of in kinds(effect):
        nothing = outcome(effect, zero, **of)
        for start in effect.initial_guesses:
            change = outcome(effect, start, **of) - nothing
            assert np.isfinite(change).all() and np.abs(change).max() > 1e-3
        for i, p in enumerate(effect.parameters if not effect.initial_guesses else ()):
            steps = (1e-3 * p.step, 1e-4 * p.step)
            coarse, fine = ((outcome(effect, _unit(effect, i, s), **of) - nothing) / s for s in steps)
            assert np.isfinite(fine).all() and np.abs(fine).max() > 0.0
            assert np.abs(coarse - fine).max() < 0.01 * np.abs(fine).max()


def _unit(effect: Effect, i: int, step: float) -> tuple[float, ...]:
    return tuple(step if j == i else 0.0 for j in range(effect.n_parameters))


@EVERY
def test_examples_and_starts_are_possible_and_do_something(effect: Effect) -> None:
    assert len(effect.examples) == 3 and effect.onsets
    sizes = [sum(abs(x) / p.step for x, p in zip(e, effect.parameters, strict=True)) for e in effect.examples]
    assert sizes == sorted(sizes)
    for values in (*effect.examples, *effect.initial_guesses):
        assert all(p.low <= x <= p.high for p, x in zip(effect.parameters, values, strict=True))
    for example in effect.examples:
        nothing = outcome(effect, (0.0,) * effect.n_parameters, **kinds(effect)[0])
        assert np.abs(outcome(effect, example, **kinds(effect)[0]) - nothing).max() > 0.0
    assert all(p.low <= 0.0 < p.step <= p.high for p in effect.parameters)


@FLOWS
def test_increments_are_of_the_table_and_alike_for_numbers_and_series(effect: Effect) -> None:
    whole, par = flow(), effect.examples[1]
    for of in kinds(effect):
        said = effect.act(whole, *par, **of)
        faded = effect.act(whole, *(x * np.ones(ROWS) for x in par), **of)
        assert set(said) <= set(INCREMENTS) and set(said) == set(faded)
        for row in (0, 123, ROWS - 1):
            alone = effect.act(at(whole, row), *par, **of)
            for name, value in said.items():
                series = np.broadcast_to(value, ROWS)
                assert np.ndim(alone[name]) == 0 and alone[name] == pytest.approx(series[row], rel=1e-12, abs=1e-15)
                assert faded[name] == pytest.approx(series, rel=1e-12, abs=1e-15)


@SENSORS
def test_minus_the_parameters_undo_a_sensor(effect: Effect) -> None:
    true, inner = readings(), slice(40, -40)
    first_order = effect.name == "gps_latency"
    for of in kinds(effect):
        for par in (*effect.examples, *([x * np.linspace(0, 1, ROWS) for x in e] for e in effect.examples)):
            said = effect.act(true, *par, **of)
            assert set(said) <= set(READINGS)
            back = effect.act(true | said, *(-x for x in par), **of)
            changed = max(np.abs(said[name] - true[name])[inner].max() for name in said)
            left = max(np.abs(back[name] - true[name])[inner].max() for name in said)
            assert left < (0.05 * changed if first_order else 1e-12)


@SERVOS
def test_a_servo_forgets_nothing_between_calls(effect: Effect) -> None:
    u, fading = commands(), np.clip(np.linspace(-1.0, 2.0, ROWS), 0.0, 1.0)
    par = np.multiply.outer(np.array(effect.examples[1]), fading)
    whole = served(effect, u, par)
    np.testing.assert_allclose(served(effect, u, par, pieces=ROWS), whole, rtol=0, atol=1e-13)  # compiled freely
    assert np.array_equal(whole[: ROWS // 3], u[: ROWS // 3]) and not np.array_equal(whole, u)


# --- what people are told --------------------------------------------------------------------------------------------


@EVERY
def test_rivals_are_of_the_catalogue_and_every_word_is_there(effect: Effect) -> None:
    assert set(effect.confusable_with) <= set(ALL) - {effect.name} and all(effect.confusable_with.values())
    words = (effect.equation, effect.source, effect.channel, *(p.meaning for p in effect.parameters))
    assert all(words) and all(p.unit for p in effect.parameters)
    assert any(year.isdigit() and 1900 < int(year) < 2100 for year in effect.source.replace(",", " ").split())


@EVERY
def test_told_numbers_have_the_names_people_want(effect: Effect) -> None:
    told = effect.reported(effect, np.array(effect.examples[1]), BODY)
    assert set(told) == TOLD.get(effect.name, {p.name for p in effect.parameters})
    assert all(np.isfinite(x) for x in told.values())


@EVERY
def test_without_an_airframe_no_value_has_a_unit_of_mass_or_length(effect: Effect) -> None:
    par = np.array(effect.examples[1])
    assert effect.values(par, BODY) == effect.reported(effect, par, BODY)
    values = effect.values(par, Body(lag=0.1))
    assert list(values.values()) == list(effect.reported(effect, par, Body(lag=0.1)).values())
    assert not any(name.startswith("dC") or name.endswith("_kg") for name in values if "_relative" not in name)
    assert sum(name.endswith("_relative") for name in values) == len(effect.of_airframe)


def test_relative_values_have_the_names_people_want() -> None:
    named = {
        name: set(ALL[name].values(np.array(ALL[name].examples[1]), Body())) for name in ("drag_increase", "cg_shift")
    }
    assert named == {"drag_increase": {"dCD_relative", "dCm_relative"}, "cg_shift": {"dx_relative"}}
    assert ALL["mass_change"].values(np.array([-0.2]), Body()) == {"dmass_relative": -0.2}


def test_channels_are_those_the_recordings_are_scored_by(recordings: Path) -> None:
    spec = importlib.util.spec_from_file_location("concealed_score", recordings / "concealed-open" / "score.py")
    assert spec and spec.loader
    score = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(score)
    assert set(score.CH) <= set(ALL)
    assert all(ALL[name].channel in channels for name, channels in score.CH.items())
