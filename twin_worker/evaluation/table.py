"""Tables of the evaluation results, with the same content as the JSON."""

from typing import Any, Literal

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from fleet.report.report_text import plain
from twin_worker.evaluation.scoring.case import OURS
from twin_worker.evaluation.scoring.compare import BEATEN, WORSE
from twin_worker.evaluation.scoring.truth import FIRST_S

_LABELS = {
    "cv": "constant velocity",
    "ct": "constant turn rate",
    "imm": "IMM (filterpy)",
    "route": "route at ground speed",
    "route_wind": "route + wind + leg speed",
    "paper": "method of the paper",
    "dynamics": "derivatives model + controller",
    OURS: "ours",
}
_ERRORS = ("5", "16", "30", "60")
_STYLES = {BEATEN: "green", WORSE: "red"}
_NOTHING = f"no prediction, and no mission flown after the first {FIRST_S:.0f} s"
_ASIDE = ("compare", "apart", "run")


def table(found: dict[str, Any]) -> RenderableType:
    """Format methods, tubes, phases, comparison and excluded starts."""
    names = [name for name in (*_LABELS, *found) if name in found and name not in _ASIDE]
    names = list(dict.fromkeys(names))
    parts: list[RenderableType] = []
    if names:
        parts += [_methods(found, names), Text(""), _trust(found, names), Text("")]
        parts += [_phases(found[OURS]["phases"]), Text("")]
        if found["compare"]:
            parts += [_compare(found["compare"]), Text("")]
    return Group(*parts, *(Text(plain(line)) for line in notes(found, names)))


def _methods(found: dict[str, Any], names: list[str]) -> Table:
    first = found[names[0]]
    title = f"{first['starts']} starts of {first['flights']} flights; t10: time within 10 % of the path flown (M1)"
    out = _table(title, "method", "t10 quartile / median [s]", "t5 [s]", "within 60 s", "M2 [s]")
    for s in _ERRORS:
        _column(out, f"p50 {s} s [m]")
    _column(out, "p90 60 s [m]")
    for name in names:
        row = found[name]
        held = "–" if row["survive_60"] is None else f"{row['survive_60']:.0%}"
        out.add_row(
            _LABELS.get(name, name),
            f"{_time(row, 'm1_t10_lq_s')} / {_time(row, 'm1_t10_median_s')}",
            _time(row, "m1_t5_lq_s"),
            held,
            _time(row, "m2_t10_lq_s"),
            *(_number(row["p50_m"].get(s)) for s in _ERRORS),
            _number(row["p90_m"].get("60")),
            style="bold" if name == OURS else "",
        )
    return out


def _trust(found: dict[str, Any], names: list[str]) -> Table:
    look = list(found[names[0]]["coverage"])
    out = _table("tube: share inside (worst flight), half-axes along / cross / vertical [m]", "look-ahead")
    its = [name for name in names if any(value is not None for value in found[name]["coverage"].values())]
    for name in its:
        _column(out, _LABELS.get(name, name))
    for s in look:
        out.add_row(f"{s} s", *(_inside(found[name], s) for name in its))
    out.add_row("horizon hit rate", *(_share(found[name]["horizon_hit_rate"]) for name in its))
    out.add_row("horizon rank correlation", *(_number(found[name]["horizon_rank_corr"], 2) for name in its))
    out.add_row("horizon median [s]", *(_number(found[name]["horizon_median_s"]) for name in its))
    return out


def _inside(row: dict[str, Any], s: str) -> str:
    axes = " / ".join(_number(value) for value in row["half_axes_m"][s])
    return f"{_share(row['coverage'][s])} ({_share(row['coverage_worst_flight'][s])})   {axes}"


def _phases(phases: dict[str, Any]) -> Table:
    out = _table("ours by flight phase after the start", "phase", "starts", "t10 quartile [s]", "within 60 s")
    for s in _ERRORS:
        _column(out, f"p50 {s} s [m]")
    for name, row in phases.items():
        errors = (_number(row["p50_m"].get(s)) for s in _ERRORS)
        out.add_row(name, str(row["starts"]), _time(row, "m1_t10_lq_s"), _share(row["survive_60"]), *errors)
    return out


def _compare(compare: dict[str, Any]) -> Table:
    out = _table("ours minus each (95 % over flights)", "method", "t10 mean [s]", "p50 16 s [m]", "60 s [m]", "skill")
    for name, row in compare.items():
        cells = [_difference(row.get(key)) for key in ("t10_s", "p50_16_m", "p50_60_m")]
        skill = " ".join(_number(row.get(f"skill_{s}"), 2) for s in (16, 60))
        out.add_row(_LABELS.get(name, name), *cells, skill)
    return out


def _difference(row: dict[str, Any] | None) -> Text:
    if row is None or row["difference"] is None:
        return Text("–")
    span = "" if row["low"] is None else f" ({row['low']:+.1f} … {row['high']:+.1f})"
    return Text(f"{row['difference']:+.1f}{span} {row['verdict']}", style=_STYLES.get(row["verdict"], ""))


def notes(found: dict[str, Any], names: list[str]) -> list[str]:
    """Return notes on fallback predictions and excluded starts."""
    lines = [] if names else [_why_none(found)]
    for name in names:
        made = found[name]["made_by"]
        others = {by: n for by, n in made.items() if by != name}
        if others:
            said = ", ".join(f"{n} by {by}" for by, n in others.items())
            lines.append(f"{_LABELS.get(name, name)}: of {found[name]['starts']} predictions {said}")
    for why, row in found["apart"].items():
        lines.append(
            f"excluded: {row['starts']} starts, {why}; ours within 10 % for {_number(row['m1_t10_lq_s'])} s (quartile)"
        )
    return lines


def _why_none(found: dict[str, Any]) -> str:
    """Return the reasons why there are no figures, from the keys `apart` and `run` of the JSON."""
    run, apart = found.get("run", {}), sum(row["starts"] for row in found["apart"].values())
    reasons = [f"{apart} are excluded, see below"] if apart else []
    if counted := run.get("counted", 0):
        reasons.append(f"{counted} lack a prediction of some method")
    if silent := run.get("silent", 0):
        reasons.append(f"{silent} on a mission have no prediction")
    return f"no start is included: {'; '.join(reasons) or _NOTHING}"


def _table(title: str, *columns: str) -> Table:
    out = Table(title=Text(title), title_justify="left", box=None, pad_edge=False, padding=(0, 1), header_style="cyan")
    for number, column in enumerate(columns):
        _column(out, column, "right" if number else "left")
    return out


def _column(out: Table, heading: str, justify: Literal["left", "right"] = "right") -> None:
    """Add a column; `Text` keeps brackets of units from being parsed as markup."""
    out.add_column(Text(heading), justify=justify, no_wrap=justify == "left")


def _number(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{value:.0f}" if abs(value) >= 100 else f"{value:.{digits}f}"


def _time(row: dict[str, Any], key: str) -> str:
    """Format a quantile of times; `>`: the quantile lies beyond the longest follow-up time."""
    value, end = row[key], row["followed_s"]
    return f"> {end:.0f}" if value is not None and end is not None and value >= end else _number(value)


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.0%}"
