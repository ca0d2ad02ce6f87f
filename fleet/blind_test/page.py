"""HTML page of a blind test: hashes, scores, flights with misses first, confusion matrix, links to flight pages."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fleet.blind_test.course import Marked, Paper
from fleet.blind_test.mark import Mark
from fleet.blind_test.score import lines
from fleet.blind_test.shown import confusion, fit, numbers, ordered
from fleet.report.html import document, safe

_HOW = (
    "JSBSim simulates every flight. The effects come from its own physics or from faults of servos and sensors that "
    "share no code with the diagnosis. The labels are encrypted and their hash is printed. The reports are written and "
    "their hash is printed. Only then are the labels decrypted."
)


def write(paper: Paper, marked: Marked, scores: Mapping[str, Any]) -> Path:
    """Write `index.html`; return its path."""
    title = f"Blind test of {len(marked.marks)} flights, seed {paper.seed}"
    body = "\n".join(
        (
            f"<h1>{title}</h1><p>{_HOW}</p>",
            f'<p class="soft">labels sha256 <code>{marked.sealed}</code><br>'
            f"reports sha256 <code>{marked.reports}</code></p>",
            _scores(scores),
            _flights(marked.marks),
            _confusion(marked.marks),
        )
    )
    path = paper.folder / "index.html"
    path.write_text(document(title, body), encoding="utf-8")
    return path


def _scores(scores: Mapping[str, Any]) -> str:
    """Show each score beside its requirement."""
    cards = []
    for one in lines(scores):
        chip = '<span class="chip none">met</span>' if one.met else '<span class="chip named">missed</span>'
        cards.append(f'<div class="card"><b>{one.reached} {chip}</b>{one.words}, {one.asked}</div>')
    return f'<div class="cards">{"".join(cards)}</div>'


def _flights(marks: Sequence[Mark]) -> str:
    heads = ("", "flight", "concealed", "named", "reported (true)", "onset", "held-out residual", "summary")
    head = "".join(f"<th>{word}</th>" for word in heads)
    return f'<table class="all"><tr>{head}</tr>{"".join(map(_flight, ordered(marks)))}</table>'


def _flight(one: Mark) -> str:
    chip = '<span class="chip none">correct</span>' if one.hit else '<span class="chip named">miss</span>'
    cells = (
        chip,
        f'<a href="{one.airframe}/pages/{one.flight}.html">{safe(one.flight)}</a><br>{safe(one.airframe)}',
        ", ".join(map(safe, one.concealed)) or "nothing",
        ", ".join(map(safe, one.said)),
        "<br>".join(map(safe, numbers(one))),
        "<br>".join(f"{dt:+.1f} s" for dt, _ in one.late),
        fit(one),
        safe(one.sentence),
    )
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _confusion(marks: Sequence[Mark]) -> str:
    """Show the confusion matrix of true and reported effects."""
    pairs = confusion(marks)
    rows, columns = (sorted({pair[i] for pair in pairs}) for i in (0, 1))
    head = "".join(f'<th class="up">{safe(name)}</th>' for name in columns)
    body = "".join(f"<tr><th>{safe(row)}</th>{''.join(_cells(row, columns, pairs))}</tr>" for row in rows)
    return f'<h3>Concealed (rows) and reported (columns)</h3><table class="grid"><tr><th></th>{head}</tr>{body}</table>'


def _cells(row: str, columns: Sequence[str], pairs: Mapping[tuple[str, str], int]) -> Iterator[str]:
    for column in columns:
        count = pairs.get((row, column), 0)
        right = row == column or (row.startswith("_") and column == "unknown")
        kind = "" if not count else ' class="right"' if right else ' class="wrong"'
        yield f"<td{kind}>{count or ''}</td>"
