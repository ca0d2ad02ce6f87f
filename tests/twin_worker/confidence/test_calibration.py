"""Calibration tables: fitted, left out, written, read, chosen; coverage and horizons on errors of known law."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from tests.support import made_up
from tests.support.made_up import GROUP, V
from twin_worker.confidence.calibration.__main__ import main
from twin_worker.confidence.calibration.evaluate_table import figures, regions_cross_fitted, regions_of_table
from twin_worker.confidence.calibration.fit_table import conformal_factors, fit, fit_sigma
from twin_worker.confidence.calibration.scored_predictions import ScoredPredictions, concatenate
from twin_worker.confidence.calibration_table import (
    INDEPENDENT,
    KNOTS,
    default_table,
    error_growth,
    uncertainty_features,
)
from twin_worker.confidence.table_files import (
    TableSet,
    TableSource,
    airframe_class,
    group_chain,
    group_name,
    load,
    read_tables,
    write,
)
from twin_worker.confidence.tube_and_horizon import LaggedForecasts
from twin_worker.confidence.weighted_quantile import (
    censored_quantile,
    kaplan_meier_masses,
    median_passage,
    survival,
    weighted_quantile,
)
from twin_worker.numerics.prediction_errors import (
    AHEAD,
    axes_error,
    first_passage,
    path_length,
    track_frame,
)


@pytest.fixture(scope="module")
def past() -> ScoredPredictions:
    return made_up.scored(10, 30, seed=1)


@pytest.fixture(scope="module")
def table(past):
    return fit(past, GROUP)


# --- misses ----------------------------------------------------------------------------------------------------------


def test_the_track_is_followed_across_the_change_of_step():
    turn = AHEAD / 12.0
    circle = 240.0 * np.column_stack([np.sin(turn), 1 - np.cos(turn), 0 * turn])
    along = track_frame(circle)
    tangent = np.column_stack([np.cos(turn), np.sin(turn)])
    assert np.min(np.sum(along * tangent, axis=1)[1:-1]) > 0.999
    many = axes_error(np.stack([circle, circle]), np.stack([circle, circle + np.array([0.0, 0.0, 2.0])]))
    assert many.shape == (2, 91, 4) and np.allclose(many[1, :, 2], 2.0) and not many[0].any()


def test_a_flight_that_was_not_followed_to_the_end_is_censored_where_it_was_lost():
    relative = np.full(91, 0.05)
    relative[40:] = np.nan
    assert first_passage(relative) == (39.0, True)
    assert first_passage(np.full(91, np.nan)) == (0.0, True)
    relative[20:30] = 0.15
    assert first_passage(relative) == (pytest.approx(19.5), False)


def test_a_path_that_begins_later_has_a_length_behind_it():
    assert path_length(made_up.LINE, V, length_before=500.0)[0] == 500.0
    assert path_length(made_up.LINE, V)[-1] == pytest.approx(180 * V)


# --- quantiles -------------------------------------------------------------------------------------------------------


def test_weighted_quantiles_are_quantiles_and_heed_the_weights():
    x = np.random.default_rng(0).standard_normal((2, 4000))
    even = weighted_quantile(x, np.ones_like(x), np.array([0.9, 0.5]))
    assert even == pytest.approx([np.quantile(x[0], 0.9), np.quantile(x[1], 0.5)], abs=1e-3)
    heavy = np.where(x > 1.0, 10.0, 1.0)
    assert weighted_quantile(x, heavy, np.array([0.5, 0.5]))[0] > 0.9
    some = np.array([[np.nan, 1.0, 2.0, np.nan]])
    assert 1.0 <= weighted_quantile(some, np.array([[0.0, 1.0, 1.0, 0.0]]), np.array([0.9]))[0] <= 2.0
    assert weighted_quantile(np.array([[3.0]]), np.ones((1, 1)), np.array([0.1]))[0] == 3.0


def test_bounds_from_above_give_their_weight_to_what_lies_below():
    x = np.array([4.0, 3.0, 2.0, 1.0])
    assert kaplan_meier_masses(x, np.ones(4), np.ones(4, bool)) == pytest.approx([0.25] * 4)
    assert kaplan_meier_masses(x, np.ones(4), np.array([True, False, True, True])) == pytest.approx(
        [0.25, 0.0, 0.375, 0.375]
    )
    assert censored_quantile(x, np.ones(4), np.zeros(4, bool), 0.9) == 0.0


def test_survival_by_hand():
    passages = [(10.0, False), (20.0, True), (30.0, False), (40.0, True)]  # 3/4, then one of two
    assert [survival(passages, t) for t in (5.0, 10.0, 11.0, 30.0, 31.0)] == [1.0, 1.0, 0.75, 0.75, 0.375]
    assert median_passage(passages) == 30.0
    assert median_passage([(10.0, False), (60.0, True), (50.0, True)]) == 60.0  # half never pass: the longest
    assert np.isnan(survival([], 10.0))


# --- fitting ---------------------------------------------------------------------------------------------------------


def test_the_fit_finds_how_much_wider_errors_are_than_the_ensemble(past):
    scale, *_ = fit_sigma(past.features, past.errors()[..., :3])
    assert np.median(scale[4:, 0]) == pytest.approx(0.8 * 2.0, rel=0.15)  # heavy tails take a normal law for narrower


def test_nine_of_ten_are_held_at_every_look_ahead(table):
    fresh = made_up.scored(40, 50, seed=2)  # 2,000 predictions it has not seen
    got = figures(fresh, regions_of_table(table, fresh))
    assert got["coverage"] == pytest.approx(0.9, abs=0.03)
    for at in (5, 16, 30, 60, 120):
        assert got[f"coverage_{at}"] == pytest.approx(0.9, abs=0.04)
    assert 1.5 * 2 < got["along_60_m"] / np.interp(60, AHEAD, made_up.GROWTH[:, 0]) < 2.6 * 2  # 2.1 sigma hold 90 %


def test_what_is_left_out_says_the_same(past):
    got = figures(past, regions_cross_fitted(past, GROUP))
    assert got["coverage"] == pytest.approx(0.9, abs=0.04)


@pytest.mark.parametrize(("together", "alone"), [(False, 0.9 ** (1 / 3)), (True, 0.9)])
def test_how_much_each_axis_alone_holds_is_measured_with_the_factors(together, alone):
    """Normal errors in each axis, of one size in all three or of three."""
    rng = np.random.default_rng(9)
    size = np.abs(rng.standard_normal((20_000, 1, 1 if together else 3))) * np.ones(3)
    factor, found = conformal_factors(size, np.ones(20_000))
    assert found == pytest.approx(alone, abs=0.004)
    assert factor == pytest.approx(np.full(3, norm.ppf((1 + alone) / 2)), abs=0.05)
    assert (size <= factor).all(axis=2).mean() == pytest.approx(0.9, abs=0.005)


def test_a_table_tells_how_much_an_axis_alone_holds_also_from_a_file(table, tmp_path):
    assert 0.94 < table.alone <= INDEPENDENT  # made up of independent axes
    write(tmp_path / "one.json", [replace(table, alone=0.93)], [], "today", "test")
    assert read_tables(tmp_path / "one.json").by_group[GROUP].alone == 0.93
    text = (tmp_path / "one.json").read_text()
    assert '"alone": 0.93' in text
    (tmp_path / "one.json").write_text(text.replace('"alone": 0.93', '"alone": 0.5'))
    with pytest.raises(ValueError, match=r"found alone 0.5 .* expected 0.9 to 1"):
        read_tables(tmp_path / "one.json")


def test_a_table_is_not_honest_of_errors_twice_as_large(table):
    fresh = made_up.scored(10, 30, seed=3, loud=2.0)
    assert figures(fresh, regions_of_table(table, fresh))["coverage"] < 0.75


def test_horizons_hold_and_tell_easy_minutes_from_hard_ones(table):
    fresh = made_up.scored(40, 50, seed=4)
    got = figures(fresh, regions_of_table(table, fresh))
    assert 0.9 <= got["hit_rate"] <= 0.99
    assert got["rank_correlation"] >= 0.5
    horizon = regions_of_table(table, fresh)[1]
    assert np.mean(horizon > 60) > 0.5 and np.mean(horizon < 60) > 0.1
    hard = fresh.features.spread[:, 40, 0] > np.quantile(fresh.features.spread[:, 40, 0], 0.8)
    assert (
        figures(fresh.select(hard), regions_of_table(table, fresh.select(hard)))["hit_rate"] >= 0.82
    )  # the hard ones hold too


def test_without_an_ensemble_the_law_of_growth_is_calibrated_instead(past):
    law = uncertainty_features(None, None, made_up.LINE, "hybrid", AHEAD)
    bare, fresh = (
        replace(of, features=replace(of.features, spread=np.array([law.spread] * len(of))))
        for of in (past, made_up.scored(20, 30, seed=5))
    )
    assert figures(fresh, regions_of_table(fit(bare, GROUP), fresh))["coverage"] == pytest.approx(0.9, abs=0.04)


def test_nobody_followed_beyond_a_minute(past):
    flown, length = past.flown.copy(), past.length.copy()
    flown[:, 61:], length[:, 61:] = np.nan, np.nan
    short = fit(replace(past, flown=flown, length=length), GROUP)
    for part in (short.scale, short.lag, short.turn, short.floor, short.factor, short.scores, short.risks):
        assert np.isfinite(part).all()
    assert (short.half_axes(past.features, AHEAD)[:, -1] > 0).all()


def test_a_wider_table_is_left_out_by_groups(past):
    other = replace(made_up.scored(4, 30, seed=6, loud=3.0), group=np.full(120, "both/arduplane/c172p/known"))
    both = concatenate([past, other])
    wide = both.folds("route/arduplane/*/known")
    assert wide.max() == 1 and both.folds(GROUP).max() == 13
    assert (fit(both, "route/arduplane/*/known").half_axes(past.features, AHEAD)[:, 30] > 10.0).any()


# --- groups and tables -----------------------------------------------------------------------------------------------


def test_a_stray_prediction_is_no_setting_of_its_own(past):
    stray = replace(
        made_up.scored(1, 3, seed=15, loud=50.0), group=np.full(3, "hybrid/arduplane/fixed_wing_fast/known")
    )
    both, group = concatenate([past, stray]), "route/arduplane/*/known"
    assert not both.spans_settings(group) and both.folds(group).max() == 10
    apart, alone = (fit(one, group).half_axes(past.features, AHEAD).mean() for one in (both, past))
    assert apart == pytest.approx(alone, rel=0.15)


def test_the_chain_of_groups_keeps_parameters_longer_than_the_airframe():
    chain = ["a/b/c/known", "a/b/*/known", "a/b/*/*", "a/*/*/*"]
    assert list(group_chain("a/b/c/known")) == chain
    assert group_chain("a") == group_chain("a/*/*/*") == ("a/*/*/*",)
    ways = ["route/arduplane/fixed_wing/known", "route/arduplane/*/known", "route/arduplane/*/*", "route/*/*/*"]
    assert list(group_chain(GROUP)) == [GROUP, *ways] and list(group_chain("both" + GROUP[6:]))[1:] == ways
    assert group_name("hybrid", "arduplane: L1 + TECS", "fixed_wing", "known") == GROUP
    assert group_name("imm", "", "", "a/b") == "imm/none/none/a b"
    assert [airframe_class("fixed_wing", v) for v in (22.0, 36.0, 50.0)] == [
        "fixed_wing",
        "fixed_wing",
        "fixed_wing_fast",
    ]
    assert airframe_class("multirotor", 50.0) == "multirotor"


def test_the_narrowest_table_is_chosen_and_said(table):
    names = [GROUP, "route/arduplane/*/known", "route/*/*/*"]
    tables = TableSet({name: replace(table, group=name) for name in names})
    for group, chosen in (
        (GROUP, names[0]),
        ("hybrid/arduplane/c172p/known", names[1]),
        ("hybrid/arduplane/c172p/absent", names[2]),
        ("hybrid/px4/fixed_wing/known", names[2]),
    ):
        found, said = tables.choose(group)
        assert found.group == chosen and chosen in said and "300 predictions of 10 flights" in said
        assert (f"none for {group}" in said) == (group != chosen)
    assert tables.choose("dynamics/arduplane/fixed_wing/known")[0].group == names[1]
    found, said = tables.choose("paper/arduplane/fixed_wing/known")
    assert found.starts == 0 and "not calibrated: no table for paper/" in said
    table, description = tables.choose("hybrid/arduplane/c172p/incomplete")
    assert table.starts == 0 and "mission items are missing" in description


@pytest.mark.parametrize("method", ["dynamics", "hybrid", "paper", "copter", "greybox", "imm", "unheard of"])
def test_an_untaught_table_is_never_narrower_than_the_law_of_growth(method):
    ahead = np.concatenate([AHEAD, [200.0, 300.0]])
    law = error_growth(method, ahead)
    for spread in (None, np.zeros((93, 3)), np.full((93, 3), 5.0)):
        path = V * ahead[:, None] * [1.0, 0.0, 0.0]
        axes = default_table(method).half_axes(uncertainty_features(spread, None, path, method, ahead), ahead)
        assert np.isfinite(axes).all() and (axes >= law * 0.99)[1:91].all() and (axes[-1] > axes[-2]).all()


@pytest.mark.parametrize("noise", [np.nan, np.inf, -np.inf, -1.0, 1e30])
def test_a_spread_that_is_nonsense_is_replaced_where_it_is(noise):
    spread = np.ones((91, 3))
    spread[30:40, 1] = noise
    got = uncertainty_features(spread, spread, made_up.LINE, "hybrid", AHEAD)
    assert np.isfinite(got.spread).all() and got.spread[29, 1] == 1.0
    assert np.allclose(got.spread[30:40, 1], error_growth("hybrid", AHEAD)[30:40, 1])
    assert np.array_equal(got.revision, got.spread)


def test_a_prediction_that_was_revised_is_in_doubt():
    earlier = LaggedForecasts()
    assert earlier.revision(0.0, AHEAD, made_up.LINE) is None
    turn = 80.0 * np.column_stack([np.sin(AHEAD / 4), 1 - np.cos(AHEAD / 4), 0 * AHEAD])
    at = (AHEAD + 5.0) / 4
    earlier.add(0.0, AHEAD, turn)
    later = 80.0 * np.column_stack([np.sin(at), 1 - np.cos(at), 0 * at])
    assert earlier.revision(3.0, AHEAD, later) is None  # so soon it says nothing
    assert earlier.revision(5.0, AHEAD, later).max() < 3.0  # the same turn: what is left is the interpolation's
    revised = earlier.revision(5.0, AHEAD, later + np.outer(AHEAD, [0.0, 0.0, 2.0]))
    assert np.allclose(revised[:80, 2], 2.0 * AHEAD[:80]) and revised[-1, 2] == revised[-2, 2]  # its end stays
    assert earlier.revision(30.0, AHEAD, later) is None and earlier.revision(5.0, AHEAD + 176.0, later) is None
    earlier.clear()
    assert earlier.revision(5.0, AHEAD, later) is None


def test_tables_are_written_and_read_back(tmp_path, table):
    path = tmp_path / "a.json"
    write(path, [table], [TableSource("p.npz", 300, ("seed-1",))], "2024-05-01", "fit p.npz")
    back = read_tables(path).by_group[GROUP]
    for name in ("scale", "lag", "turn", "floor", "factor", "scores", "risks"):
        assert np.allclose(getattr(back, name), getattr(table, name), rtol=1e-3)
    assert json.loads(path.read_text())["sources"] == [{"file": "p.npz", "starts": 300, "flights": ["seed-1"]}]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: "",
        lambda text: text[:200],
        lambda text: "[]",
        lambda text: text.replace('"format": 2', '"format": 9'),
        lambda text: text.replace('"factor": [', '"factor": [1.0, '),
        lambda text: text.replace('"floor": [\n    [', '"floor": [\n    [-1.0, '),
        lambda text: text.replace('"factor": [', '"factor": [1e9, ', 1).replace(", ", "", 1),
    ],
)
def test_a_broken_file_of_tables_is_a_sentence(tmp_path, table, spoil):
    write(tmp_path / "good.json", [table], [], "", "")
    text = (tmp_path / "good.json").read_text()
    (tmp_path / "bad.json").write_text(spoil(text))
    with pytest.raises(ValueError, match=r"^calibration bad.json: found .*; fit it again$"):
        read_tables(tmp_path / "bad.json")
    tables = load(tmp_path)
    assert list(tables.by_group) == [GROUP] and tables.sentence.startswith("calibration bad.json: found")
    assert tables.sentence in tables.choose("imm/none/fixed_wing/known")[1]


def test_a_folder_without_tables_is_no_trouble(tmp_path):
    assert load(tmp_path / "nowhere").by_group == {}


def test_the_tables_that_come_along_are_whole():
    tables = load()
    assert not tables.sentence
    for name, table in tables.by_group.items():
        assert name == table.group and table.flights >= 3 and (np.diff(table.risks) >= 0).all()
        assert 0.8 <= table.held_out["coverage"] <= 1.0


# --- the command -----------------------------------------------------------------------------------------------------


def arrays(scored: ScoredPredictions) -> dict[str, np.ndarray]:
    names = ("t0", "path", "flown", "length", "predicted_length", "group", "method", "flight")
    return {"ahead": AHEAD, "spread": scored.features.spread} | {name: getattr(scored, name) for name in names}


def as_npz(path, scored: ScoredPredictions) -> None:
    np.savez(path, **arrays(scored))


def test_the_command_fits_and_checks(tmp_path, capsys, past):
    as_npz(tmp_path / "p.npz", past.select(np.arange(150)))
    as_npz(tmp_path / "few.npz", made_up.scored(2, 12, seed=7, group="imm/none/fixed_wing/known"))
    out = tmp_path / "t.json"
    assert main(["fit", str(tmp_path / "p.npz"), str(tmp_path / "few.npz"), "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert f"{GROUP}: 150 predictions of 5 flights; flights left out: coverage" in told
    assert "imm/none/fixed_wing/known: no table from 24 predictions, 2 flights; 30 of 3 are needed" in told
    sheet = json.loads(out.read_text())
    folder = tmp_path.name
    assert sheet["command"].endswith(f"fit {folder}/p.npz {folder}/few.npz") and str(tmp_path) not in out.read_text()
    assert {t["group"] for t in sheet["tables"]} == set(group_chain(GROUP))
    assert main(["check", str(tmp_path / "p.npz"), "--with", str(out)]) == 0
    told = capsys.readouterr().out
    assert "table alone: coverage" in told and "adapted in flight: coverage" in told
    assert KNOTS.tolist() == sheet["knots_s"]


def test_few_flights_of_one_way_are_told_by_those_of_all(tmp_path, capsys, past):
    as_npz(tmp_path / "p.npz", past)
    as_npz(tmp_path / "q.npz", made_up.scored(4, 15, seed=14, group="both" + GROUP[6:]))
    out = tmp_path / "t.json"
    assert main(["fit", str(tmp_path / "p.npz"), str(tmp_path / "q.npz"), "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "no table from 60 predictions, 4 flights; with those of route/arduplane/fixed_wing/known there are" in told
    found = read_tables(out).by_group
    assert set(found) == set(group_chain(GROUP)) and found["route/*/*/*"].starts == 360
    assert "route/arduplane/fixed_wing/known: 360 predictions of 14 flights; flights left out" in told


def test_the_command_says_what_is_wrong(tmp_path, capsys, past):
    bad = tmp_path / "bad.npz"
    bad.write_bytes(b"nothing")
    out = ["--out", str(tmp_path / "t.json")]
    assert main(["fit", str(bad), *out]) == 2
    assert "bad.npz: found no scored predictions" in capsys.readouterr().err
    np.savez(bad, **arrays(past) | {"ahead": np.arange(61.0)})
    assert main(["fit", str(bad), *out]) == 2 and "another look-ahead grid" in capsys.readouterr().err
    as_npz(bad, replace(past, flown=past.flown[:, :61]))
    assert main(["fit", str(bad), *out]) == 2 and "found flown of shape" in capsys.readouterr().err
    as_npz(bad, past.select(np.arange(3)))
    assert main(["fit", str(bad), *out]) == 2 and "give more flights" in capsys.readouterr().err
