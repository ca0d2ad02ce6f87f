"""HTML page of a blind test: hashes, scores, flights with misses first, confusion matrix, links to flight pages."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fleet.blind_test.course import BlindTestConfig, BlindTestResult
from fleet.blind_test.mark import PROBABILITIES, GradedFlight, score_rows
from fleet.blind_test.shown import confusion, fit_text, misses_first, parameter_texts
from fleet.report.ink import GRID, LINES, MUTED, document, escape_text

_METHOD = (
    "JSBSim simulates every flight. The effects come from its own physics or from faults of servos and sensors that "
    "share no code with the diagnosis. The labels are encrypted and their hash is printed. The reports are written and "
    "their hash is printed. Only then are the labels decrypted."
)

_METHOD_INJECTED = (
    "Every flight is a healthy recording with a concealed fault: the recorded motion is kept, outputs and readings are "
    "those of a faulty aircraft that flies it. Copies of one recording are not independent of each other. The labels "
    "are encrypted and their hash is printed. The reports are written and their hash is printed. Only then are the "
    "labels decrypted."
)
_PLOT_PX, _MARGIN_PX = 220, 34


def write(config: BlindTestConfig, outcome: BlindTestResult, scores: Mapping[str, Any]) -> Path:
    """Write `index.html`; return its path."""
    title = f"Blind test of {len(outcome.results)} flights, seed {config.seed}"
    body = "\n".join(
        (
            f"<h1>{title}</h1><p>{_METHOD_INJECTED if config.injected else _METHOD}</p>",
            f'<p class="soft">labels sha256 <code>{outcome.labels_sha256}</code><br>'
            f"reports sha256 <code>{outcome.reports_sha256}</code></p>",
            _scores(scores),
            *(_reliability(scores[key], meaning) for key, meaning in PROBABILITIES.items()),
            _flights(outcome.results),
            _confusion(outcome.results),
        )
    )
    path = config.folder / "index.html"
    path.write_text(document(title, body), encoding="utf-8")
    return path


def _scores(scores: Mapping[str, Any]) -> str:
    """Show each score beside its requirement."""
    cards = []
    for met, meaning, required, achieved in score_rows(scores):
        chip = '<span class="chip none">met</span>' if met else '<span class="chip named">missed</span>'
        chip = "" if met is None else chip
        cards.append(f'<div class="card"><b>{achieved} {chip}</b>{", ".join(filter(None, (meaning, required)))}</div>')
    return f'<div class="cards">{"".join(cards)}</div>'


def _reliability(probabilities: Mapping[str, Any] | None, meaning: str) -> str:
    """Draw the reliability diagram: stated probability against the share of true candidates, with intervals."""
    if probabilities is None:
        return ""

    def x(share: float) -> str:
        return f"{_MARGIN_PX + _PLOT_PX * share:.1f}"

    def y(share: float) -> str:
        return f"{_PLOT_PX * (1.0 - share) + 8:.1f}"

    marks = [f'<line x1="{x(0)}" y1="{y(0)}" x2="{x(1)}" y2="{y(1)}" stroke="{GRID}"/>']
    for one in probabilities["bins"]:
        at, (low, high) = x(one["stated"]), one["interval"]
        marks.append(f'<line x1="{at}" y1="{y(low)}" x2="{at}" y2="{y(high)}" stroke="{LINES[0]}"/>')
        title = f"<title>{one['n']} candidates</title>"
        marks.append(f'<circle cx="{at}" cy="{y(one["share"])}" r="4" fill="{LINES[0]}">{title}</circle>')
    texts = [(x(0.5), _PLOT_PX + 28, "stated probability"), (x(0.0), 6, "share of true candidates")]
    marks += [f'<text x="{at}" y="{down}" font-size="11" fill="{MUTED}">{text}</text>' for at, down, text in texts]
    size = _PLOT_PX + 2 * _MARGIN_PX
    return f'<h3>Stated: {meaning}</h3><svg viewBox="0 0 {size} {size}" width="{size}">{"".join(marks)}</svg>'


def _flights(results: Sequence[GradedFlight]) -> str:
    headings = (
        "",
        "flight",
        "concealed",
        "named",
        "reported (true)",
        "onset",
        "held-out force error [m/s2]",
        "summary",
    )
    head = "".join(f"<th>{heading}</th>" for heading in headings)
    return f'<table class="all"><tr>{head}</tr>{"".join(map(_flight, misses_first(results)))}</table>'


def _flight(result: GradedFlight) -> str:
    chip = '<span class="chip none">correct</span>' if result.hit else '<span class="chip named">miss</span>'
    link = f'<a href="{result.airframe}/pages/{result.flight}.html">{escape_text(result.flight)}</a>'
    cells = (
        chip,
        f"{link}<br>{escape_text(result.airframe)}",
        ", ".join(map(escape_text, result.concealed)) or "nothing",
        ", ".join(map(escape_text, result.reported_names)),
        "<br>".join(map(escape_text, parameter_texts(result))),
        "<br>".join(f"{dt:+.1f} s" for dt, _ in result.late),
        fit_text(result),
        escape_text(result.sentence),
    )
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _confusion(results: Sequence[GradedFlight]) -> str:
    """Show the confusion matrix of true and reported effects."""
    pairs = confusion(results)
    rows, columns = (sorted({pair[i] for pair in pairs}) for i in (0, 1))
    head = "".join(f'<th class="up">{escape_text(name)}</th>' for name in columns)
    body = "".join(f"<tr><th>{escape_text(row)}</th>{''.join(_cells(row, columns, pairs))}</tr>" for row in rows)
    return f'<h3>Concealed (rows) and reported (columns)</h3><table class="grid"><tr><th></th>{head}</tr>{body}</table>'


def _cells(row: str, columns: Sequence[str], pairs: Mapping[tuple[str, str], int]) -> Iterator[str]:
    for column in columns:
        count = pairs.get((row, column), 0)
        correct = row == column or (row.startswith("_") and column == "unknown")
        css_class = "" if not count else ' class="right"' if correct else ' class="wrong"'
        yield f"<td{css_class}>{count or ''}</td>"
