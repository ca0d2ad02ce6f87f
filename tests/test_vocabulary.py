"""Names and texts: standard terms only, one name for one class, and one module that writes each part of the state."""

import ast
import functools
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT

PACKAGES = ("fleet", "gateway", "twin_worker", "viewer")
EVERYDAY = frozenset({
    "aside", "asked", "asks", "attend", "bars", "believed", "bygone", "chronicle", "dialled", "doubt", "earned",
    "elsewhere", "flock", "flown", "foresee", "foretell", "found", "gather", "gone", "guess", "hand", "hands",
    "heap", "hear", "heard", "held", "hurry", "inquire", "instead", "kept", "knew", "knows", "laid", "lay",
    "learnt", "lesson", "noted", "outbox", "overhear", "patience", "pretend", "recast", "recount", "said",
    "say", "sheet", "sight", "stood", "strange", "stray", "strays", "stumble", "taped", "taught", "tell",
    "told", "volley", "wants",
})  # fmt: skip
"""Words that say nothing without their surroundings; the field has a term for each use (see docs/architecture.md)."""
WORDS_ALLOWED = {
    "fleet/telemetry/inspection/findings.py flown": "JSON key of `inspect`",
    "twin_worker/confidence/calibration/scored_predictions.py flown": "column of stored predictions.npz",
    "fleet/telemetry/onboard_logs/ulog/sieve.py tell": "method of a file object, which pyulog calls",
    "fleet/blind_test/mark.py told": "JSON key of `prove`",
}
"""Identifiers that keep such a word: file and name, and why."""
CLASSES_ALLOWED: dict[str, str] = {}
"""Class names that occur more than once, and why."""
PARTS = {
    "telemetry": "twin_worker/twin/state/inputs.py",
    "onboard": "twin_worker/twin/state/inputs.py",
    "environment": "twin_worker/twin/state/inputs.py",
    "identification": "twin_worker/twin/state/models.py",
    "models": "twin_worker/twin/state/models.py",
    "prediction": "twin_worker/twin/state/outputs.py",
    "confidence": "twin_worker/twin/state/outputs.py",
    "alerts": "twin_worker/twin/state/outputs.py",
}
"""Each part of a twin's state, and the one module that writes it."""


def sources() -> Iterator[tuple[str, str]]:
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield str(path.relative_to(ROOT)), path.read_text()


class Facts:
    """What the rules ask of the text of a module, collected in one walk through its tree."""

    def __init__(self, text: str) -> None:
        self.identifiers: list[tuple[str, int]] = []  # that it defines, with their lines
        self.giving: list[str] = []  # what has a docstring that begins with Give
        self.classes: list[str] = []
        self.written: list[tuple[str, str]] = []  # part of the state, and the assignment to a field of it
        for node in ast.walk(ast.parse(text)):
            self.identifiers += defined(node)
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                if (ast.get_docstring(node) or "").startswith("Give"):
                    self.giving.append(getattr(node, "name", "module"))
                if isinstance(node, ast.ClassDef):
                    self.classes.append(node.name)
            elif (
                isinstance(node, ast.Attribute)
                and isinstance(node.ctx, ast.Store | ast.Del)
                and isinstance(node.value, ast.Attribute)
                and isinstance(node.value.value, ast.Name)
            ):
                self.written.append((node.value.attr, f"{node.lineno} {ast.unparse(node)}"))


facts = functools.cache(Facts)


def defined(node: ast.AST) -> Iterator[tuple[str, int]]:
    """The identifiers that a node defines, with their lines."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        yield node.name, node.lineno
    elif isinstance(node, ast.arg):
        yield node.arg, node.lineno
    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        yield node.id, node.lineno
    elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
        yield node.attr, node.lineno
    elif isinstance(node, ast.ExceptHandler | ast.MatchAs) and node.name:
        yield node.name, node.lineno
    elif isinstance(node, ast.alias) and node.asname:
        yield node.asname, node.lineno


@functools.cache
def words(identifier: str) -> list[str]:
    identifier = re.sub(r"held_?out", "", identifier, flags=re.IGNORECASE)  # held-out data is a term of statistics
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", identifier)]


def everyday(files: dict[str, str]) -> list[str]:
    return [
        f"{name}:{line} {identifier}"
        for name, text in files.items()
        for identifier, line in facts(text).identifiers
        if f"{name} {identifier}" not in WORDS_ALLOWED and EVERYDAY.intersection(words(identifier))
    ]


def giving(files: dict[str, str]) -> list[str]:
    return [f"{name}: {what}" for name, text in files.items() for what in facts(text).giving]


def repeated(files: dict[str, str]) -> dict[str, list[str]]:
    where = defaultdict(list)
    for name, text in files.items():
        for kind in facts(text).classes:
            where[kind].append(name)
    return {name: places for name, places in where.items() if len(places) > 1 and name not in CLASSES_ALLOWED}


def written_elsewhere(files: dict[str, str]) -> list[str]:
    """Assignments to a field of a part, as in `twin.models.point_mass = …`, outside of the part's module."""
    return [
        f"{name}:{assignment}"
        for name, text in files.items()
        for part, assignment in facts(text).written
        if name.startswith("twin_worker/") and PARTS.get(part, name) != name
    ]


def test_identifiers_use_the_terms_of_the_field() -> None:
    assert everyday(dict(sources())) == []


def test_no_docstring_begins_with_give() -> None:
    assert giving(dict(sources())) == []


def test_no_class_name_is_used_twice() -> None:
    assert repeated(dict(sources())) == {}
    assert len(CLASSES_ALLOWED) <= 10


def test_every_part_of_the_state_is_written_by_one_module() -> None:
    files = dict(sources())
    assert written_elsewhere(files) == []
    assert set(PARTS.values()) <= set(files)
    twin = next(
        node
        for node in ast.parse(files["twin_worker/twin/state/state.py"]).body
        if isinstance(node, ast.ClassDef) and node.name == "Twin"
    )
    fields = {
        node.target.id for node in twin.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    assert fields == {*PARTS, "config", "budget", "terrain", "areas"}


def test_every_exception_is_needed() -> None:
    names = {f"{name} {identifier}" for name, text in sources() for identifier, _ in facts(text).identifiers}
    assert set(WORDS_ALLOWED) <= names and len(WORDS_ALLOWED) <= 10
    assert set(CLASSES_ALLOWED) <= {name.partition(" ")[2] for name in names}
    assert all(WORDS_ALLOWED.values()) and all(CLASSES_ALLOWED.values())


@pytest.mark.parametrize(
    "planted",
    [
        "found = 1",
        "def said(): ...",
        "class Heard: ...",
        "def f(told): ...",
        "self.stray_m = 0",
        "for kept in (): ...",
        "MOST_HELD = 3",
        "from fleet import contract as told",
        "def _asWasToldBefore(): ...",
    ],
)
def test_a_planted_word_is_noticed(planted: str) -> None:
    assert len(everyday({"fleet/planted.py": planted})) == 1


def test_planted_breaches_are_noticed() -> None:
    assert giving({"fleet/planted.py": '"""Give a number."""'})
    assert repeated({"fleet/a.py": "class Thing: ...", "fleet/b.py": "class Thing: ..."})
    assert written_elsewhere({"twin_worker/twin/steps/planted.py": "twin.models.point_mass = None"})
    assert not written_elsewhere({PARTS["models"]: "twin.models.point_mass = None"})
    assert not everyday({"fleet/planted.py": "profound = background = handle = sayings = 1"})


def test_the_packages_are_where_they_are_looked_for() -> None:
    assert all((Path(ROOT) / package / "__init__.py").exists() for package in PACKAGES)
