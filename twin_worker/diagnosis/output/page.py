"""Write a self-contained HTML page per flight: findings, evidence, figures and rivals."""

import base64
from collections.abc import Iterator, Sequence
from math import floor, isfinite, log10
from pathlib import Path

from fleet.effects import Effect
from fleet.report.html import document, safe
from twin_worker.diagnosis.inference.report import Finding, Outcome, Report
from twin_worker.diagnosis.output.figures import draw, stems
from twin_worker.diagnosis.output.marks import MEANING, SAID, times

_UNITS = {  # suffix of a parameter name -> unit; the first match counts
    "mps_per_100m": "m/s per 100 m",
    "_per_100s": "per 100 s",
    "_per_rad": "1/rad",
    "_per_s": "1/s",
    "_mps2": "m/s²",
    "_mps": "m/s",
    "_dps": "°/s",
    "_deg": "°",
    "_kg": "kg",
    "_m": "m",
    "_s": "s",
}
_CAPTIONS = (
    "Location: path from above and height over time, located segments in colour",
    "Signature: residuals before and after",
    "Evidence: measured against simulated force; shaded blocks were held out of the fit",
    "Candidates: gain of each, and those not separable from the selected",
)


def write(reports: Sequence[Report], folder: Path) -> Path:
    """Write a page with figures for every flight, and an overview of several; return the page to open first.

    Args:
        reports: one per flight, in display order
        folder: created if missing; also contains the figure files
    """
    folder.mkdir(parents=True, exist_ok=True)
    _, *names = stems(["index", *(report.flight for report in reports)])
    index = folder / "index.html"
    for report, stem in zip(reports, names, strict=True):
        path = index if len(reports) == 1 else folder / f"{stem}.html"
        whole = document(f"Diagnosis of {report.flight}", _section(report, draw(report, folder, stem)))
        path.write_text(whole, encoding="utf-8")
    if len(reports) != 1:
        title = f"Diagnosis of {len(reports)} flights"
        index.write_text(document(title, _overview(title, reports, names)), encoding="utf-8")
    return index


def _overview(title: str, reports: Sequence[Report], names: Sequence[str]) -> str:
    """Return a table of all flights with their summary sentences."""
    rows = "".join(
        f'<tr><td>{_chip(one.outcome)}</td><td><a href="{name}.html">{safe(one.flight)}</a></td>'
        f'<td>{safe(one.sentence)}</td><td class="num">{_change(one.fit_before, one.fit_after)}</td></tr>'
        for name, one in zip(names, reports, strict=True)
    )
    head = "<tr><th>outcome</th><th>flight</th><th>summary</th><th class='num'>held-out residual</th></tr>"
    return f'<h1>{title}</h1>\n<table class="all">{head}{rows}</table>'


def _section(report: Report, figures: Sequence[Path]) -> str:
    parts = (
        f"<h2>{_chip(report.outcome)} {safe(report.flight)}</h2>",
        f'<p class="say">{safe(report.sentence)}</p>',
        _cards(report),
        *(_finding(one) for one in report.findings),
        _unknown(report),
        _lacks(report),
        *_figures(report, figures),
    )
    return "<section>" + "\n".join(filter(None, parts)) + "</section>"


def _cards(report: Report) -> str:
    """Return cards with the errors on held-out data, before and after."""
    told = {
        "residual on held-out blocks, whitened rms": _change(report.fit_before, report.fit_after),
        "simulated specific force on held-out blocks, rms error [m/s²]": _change(
            report.force_before, report.force_after
        ),
        "computed in": f"{report.seconds:.1f} s",
    }
    cards = "".join(f'<div class="card"><b>{value}</b>{words}</div>' for words, value in told.items() if value)
    return f'<div class="cards">{cards}</div>'


def _finding(one: Finding) -> str:
    """Return the section of one effect: parameters, location, time, rivals."""
    effect = one.guess.effect
    where = ", ".join(filter(None, (one.channel, one.surface)))
    rows = "".join(
        f'<tr><td>{safe(name)}</td><td class="num">{amount(value, one.sigma.get(name, float("nan")))}</td>'
        f"<td>{safe(unit(name, effect))}</td></tr>"
        for name, value in one.told.items()
    )
    rivals = "".join(_rival(name, apart, effect) for name, apart in zip(one.rivals, one.apart, strict=True))
    apart = f"<p>Not separable from:</p><ul>{rivals}</ul>" if rivals else "<p>Separable from every other effect.</p>"
    held = f"{100 * one.held:.0f} % of its gain is present on held-out data; gain" if one.held else "Gain"
    return (
        f"<h3>{safe(one.guess.label)}</h3><p><code>{safe(effect.equation)}</code></p>"
        f"<p>Where: {safe(where)}. When: {times(one.segments)}. "
        f'<span class="soft">{held} {one.gain:,.0f}.</span></p>'
        f'<table><tr><th>number</th><th class="num">value ± standard deviation</th><th>unit</th></tr>{rows}</table>'
        f"<p>{apart}</p>"
    )


def _rival(name: str, apart: str, effect: Effect) -> str:
    """Return one rival with the known difference and the manoeuvre that separates it."""
    known = effect.confused.get(name)
    words = ". ".join(filter(None, (known, f"To separate them: {apart}")))
    return f'<li><b>{safe(name)}</b> <span class="soft">{safe(words)}.</span></li>'


def _unknown(report: Report) -> str:
    """Return the section of an unknown mismatch: location, time, free-form term."""
    if report.outcome is not Outcome.UNKNOWN:
        return ""
    channel, segments = report.where
    where = safe(MEANING.get(channel, channel) or "no single channel")
    said = f"<h3>Unknown</h3><p>Where: {where}. When: {times(segments)}.</p>"
    if not report.terms:
        return said
    rows = "".join(
        f'<tr><td>{safe(term)}</td><td class="num">{coefficient:.3g}</td></tr>'
        for term, coefficient in report.terms.items()
    )
    head = '<tr><th>term</th><th class="num">coefficient</th></tr>'
    words = "Sparse free-form fit of the residual, without physical meaning."
    return f"{said}<p>{words}</p><table>{head}{rows}</table>"


def _lacks(report: Report) -> str:
    items = "".join(f"<li>{safe(words)}</li>" for words in report.lacks)
    return f"<h3>Limitations</h3><ul>{items}</ul>" if items else ""


def _figures(report: Report, figures: Sequence[Path]) -> Iterator[str]:
    for path, caption in zip(figures, _CAPTIONS, strict=True):
        data = base64.b64encode(path.read_bytes()).decode()
        yield (
            f"<figure><figcaption>{caption}</figcaption>"
            f'<img alt="{safe(report.flight)}: {caption}" src="data:image/png;base64,{data}"></figure>'
        )


def amount(value: float, sigma: float) -> str:
    """Format a value and its standard deviation, both to the second digit of the latter."""
    if not isfinite(value):
        return "not known"
    if not (isfinite(sigma) and sigma > 0.0):
        return f"{value:.3g} ± not known"
    digits = min(max(1 - floor(log10(sigma)), 0), 9)
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def unit(name: str, effect: Effect) -> str:
    """Return the unit of a value, from the suffix of its name or from the effect parameter of that name."""
    suffix = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    own = next((p.unit for p in effect.parameters if p.name == name), "")
    return suffix or own.removeprefix("-") or "–"


def _change(before: float, after: float) -> str:
    """Format before → after and the relative change; empty if unknown."""
    if not (isfinite(before) and isfinite(after)):
        return f"{before:.2f}" if isfinite(before) else ""
    share = f" ({100 * (after / before - 1):+.0f} %)".replace("-", "−") if before > 0.0 else ""
    return f"{before:.2f} → {after:.2f}{share}"


def _chip(outcome: Outcome) -> str:
    return f'<span class="chip {outcome.value}">{SAID[outcome]}</span>'
