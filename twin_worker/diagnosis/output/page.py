"""Write a self-contained HTML page per flight: findings, evidence, figures and rivals."""

import base64
from collections.abc import Iterator, Sequence
from math import floor, isfinite, log10
from pathlib import Path

from fleet.effects import Effect
from fleet.report.ink import document, escape_text
from twin_worker.diagnosis.inference.report import DiagnosisFinding, Report, ReportOutcome
from twin_worker.diagnosis.output.figures import draw, stems
from twin_worker.diagnosis.output.traces import CHANNEL_TEXT, OUTCOME_TEXT, format_segments

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
        html_page = document(f"Diagnosis of {report.flight}", _section(report, draw(report, folder, stem)))
        path.write_text(html_page, encoding="utf-8")
    if len(reports) != 1:
        title = f"Diagnosis of {len(reports)} flights"
        index.write_text(document(title, _overview(title, reports, names)), encoding="utf-8")
    return index


def _overview(title: str, reports: Sequence[Report], names: Sequence[str]) -> str:
    table_rows = "".join(
        f'<tr><td>{_chip(report.outcome)}</td><td><a href="{name}.html">{escape_text(report.flight)}</a></td>'
        f"<td>{escape_text(report.sentence)}</td><td "
        f'class="num">{_change(report.fit_before, report.fit_after)}</td></tr>'
        for name, report in zip(names, reports, strict=True)
    )
    head = "<tr><th>outcome</th><th>flight</th><th>summary</th><th class='num'>held-out residual</th></tr>"
    return f'<h1>{title}</h1>\n<table class="all">{head}{table_rows}</table>'


def _section(report: Report, figures: Sequence[Path]) -> str:
    detection = "".join(f"<li>{escape_text(sentence)}</li>" for sentence in report.detection_limits)
    limitations = "".join(f"<li>{escape_text(limitation)}</li>" for limitation in report.limitations)
    parts = (
        f"<h2>{_chip(report.outcome)} {escape_text(report.flight)}</h2>",
        f'<p class="say">{escape_text(report.sentence)}</p>',
        _cards(report),
        *(_finding_section(finding) for finding in report.findings),
        _unknown_section(report),
        f"<h3>Limitations</h3><ul>{limitations}</ul>" if limitations else "",
        f"<h3>Limits of detection</h3><ul>{detection}</ul>" if detection else "",
        *_figures(report, figures),
    )
    return "<section>" + "\n".join(filter(None, parts)) + "</section>"


def _cards(report: Report) -> str:
    """Return cards with the errors on held-out data, before and after."""
    force = _change(report.force_before, report.force_after)
    values_by_label = {
        "residual on held-out blocks, whitened rms": _change(report.fit_before, report.fit_after),
        "simulated specific force on held-out blocks, rms error [m/s²]": force,
        "computed in": f"{report.seconds:.1f} s",
    }
    cards = "".join(
        f'<div class="card"><b>{value}</b>{label}</div>' for label, value in values_by_label.items() if value
    )
    return f'<div class="cards">{cards}</div>'


def _finding_section(finding: DiagnosisFinding) -> str:
    """Return the section of one effect: parameters, location, time, rivals."""
    effect = finding.hypothesis.effect
    where = ", ".join(filter(None, (finding.channel, finding.surface)))
    table_rows = "".join(
        f'<tr><td>{escape_text(name)}</td><td class="num">{amount(value, finding.sigma.get(name, float("nan")))}</td>'
        f"<td>{escape_text(unit(name, effect))}</td></tr>"
        for name, value in finding.reported.items()
    )
    rivals = ""
    for name, manoeuvre in zip(finding.rivals, finding.manoeuvres, strict=True):
        text = ". ".join(filter(None, (effect.confusable_with.get(name), f"To separate them: {manoeuvre}")))
        rivals += f'<li><b>{escape_text(name)}</b> <span class="soft">{escape_text(text)}.</span></li>'
    rival_list = "<p>Separable from every other effect.</p>"
    if rivals:
        rival_list = f"<p>Not separable from:</p><ul>{rivals}</ul>"
    gain_text = "Gain"
    if finding.held_out_share:
        gain_text = f"{100 * finding.held_out_share:.0f} % of its gain is present on held-out data; gain"
    return (
        f"<h3>{escape_text(finding.hypothesis.label)}</h3><p><code>{escape_text(effect.equation)}</code></p>"
        f"<p>Where: {escape_text(where)}. When: {format_segments(finding.segments)}. "
        f'<span class="soft">{gain_text} {finding.gain:,.0f}.</span></p>'
        '<table><tr><th>number</th><th class="num">value ± standard '
        f"deviation</th><th>unit</th></tr>{table_rows}</table>"
        f"<p>{rival_list}</p>"
    )


def _unknown_section(report: Report) -> str:
    """Return the section of an unknown mismatch: location, time, free-form term."""
    if report.outcome is not ReportOutcome.UNKNOWN:
        return ""
    channel, segments = report.where
    where = escape_text(CHANNEL_TEXT.get(channel, channel) or "no single channel")
    intro = f"<h3>Unknown</h3><p>Where: {where}. When: {format_segments(segments)}.</p>"
    if not report.terms:
        return intro
    table_rows = "".join(
        f'<tr><td>{escape_text(term)}</td><td class="num">{coefficient:.3g}</td></tr>'
        for term, coefficient in report.terms.items()
    )
    head = '<tr><th>term</th><th class="num">coefficient</th></tr>'
    note = "Sparse free-form fit of the residual, without physical meaning."
    return f"{intro}<p>{note}</p><table>{head}{table_rows}</table>"


def _figures(report: Report, figures: Sequence[Path]) -> Iterator[str]:
    for path, caption in zip(figures, _CAPTIONS, strict=True):
        data = base64.b64encode(path.read_bytes()).decode()
        yield (
            f"<figure><figcaption>{caption}</figcaption>"
            f'<img alt="{escape_text(report.flight)}: {caption}" src="data:image/png;base64,{data}"></figure>'
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


def _chip(outcome: ReportOutcome) -> str:
    return f'<span class="chip {outcome.value}">{OUTCOME_TEXT[outcome]}</span>'
