"""The law of the house, read off the source: who may import whom, sizes, docstrings, names."""

import ast
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import LONG_FILES, ROOT

PACKAGES = ("fleet", "gateway", "twin_worker", "viewer")

ROOMS = (  # inside fleet a room imports only from rooms above it, and from itself
    ("frames", "heap", "interrupt", "plain", "private"),
    ("logs",),
    ("contract",),
    ("access",),
    ("codec",),
    ("talk",),
    ("fence", "memory_bus", "presence"),
    ("bus",),
    ("window",),
    ("airframe", "airframes"),
    ("mission",),
    ("physics",),
    ("effects",),
    ("autopilots",),
    ("simulate", "hybrid"),
    ("telemetry",),
    ("sheet", "page", "bars"),
    ("pretend",),
    ("config",),
    ("children",),
    ("cli", "commands", "prove", "metrics", "examine"),
)
RANK = {f"fleet.{name}": rank for rank, names in enumerate(ROOMS) for name in names}

ALONE = {  # a foreign library, and the only places that may import it
    "zenoh": ("fleet/bus/session.py",),
    "viser": ("viewer/",),
    "jsbsim": ("fleet/simulator/vehicle/jsbsim.py",),
    "pymavlink": (
        "fleet/telemetry/",
        "fleet/simulator/flight/mavlink.py",
        "fleet/simulator/flight/mavlink_messages.py",
        "gateway/",
    ),
}

APART = (  # who, and what it must never import
    ("fleet", ("gateway", "twin_worker", "viewer")),
    ("gateway", ("twin_worker", "viewer")),
    ("twin_worker", ("gateway", "viewer", "fleet.simulator")),
    ("viewer", ("gateway", "twin_worker", "fleet.simulator")),
    (
        "fleet.simulator",
        ("fleet.physics", "fleet.effects", "fleet.physics.simulate", "fleet.physics.point_mass"),
    ),  # never our own physics
    ("fleet.simulator", ("importlib", "runpy", "subprocess")),  # nor by the back door
    ("fleet.effects", ("fleet.simulator",)),  # one code must never both conceal and find
    ("fleet.physics.simulate", ("fleet.simulator",)),
    ("twin_worker.diagnosis", ("fleet.simulator", "fleet.blind_test")),
    ("fleet.blind_test", ("fleet.physics", "fleet.effects", "fleet.physics.simulate", "fleet.physics.point_mass")),
)

TABLES = ("fleet/contract.py", "fleet/telemetry/tables/")  # data, so they may be long
BANNED_NAMES = ("utils.py", "helpers.py", "common.py", "misc.py")
NOT_IMPERATIVE = {"a", "an", "the", "this", "it", "returns", "gets", "function", "method"}


# --- reading ---------------------------------------------------------------------------------------------------------


def module_name(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def imported(path: str, tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Every module a file imports: (line, dotted name), relative ones made absolute."""
    parts = module_name(path).split(".")
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            up = node.level - path.endswith("__init__.py") if node.level else 0
            base = ".".join(parts[: len(parts) - up]) if node.level else ""
            name = ".".join(filter(None, (base, node.module)))
            yield from ((node.lineno, f"{name}.{alias.name}") for alias in node.names)


def inside(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def rank(name: str) -> int | None:
    return next((r for room, r in RANK.items() if inside(name, room)), None)


# --- the rules: (path, tree, text) -> complaints ---------------------------------------------------------------------


def direction(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    me = module_name(path)
    for line, name in imported(path, tree):
        for who, never in APART:
            if inside(me, who) and any(inside(name, other) for other in never):
                yield f"{path}:{line}: {who} imports {name}; it may not, turn the dependency round"
        mine, theirs = rank(me), rank(name)
        if mine is not None and theirs is not None and theirs > mine:
            yield f"{path}:{line}: imports {name} from a room below it; move what is shared up"


def alone(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    for line, name in imported(path, tree):
        allowed = ALONE.get(name.split(".")[0])
        if allowed and path.startswith(PACKAGES) and not path.startswith(allowed):
            yield f"{path}:{line}: imports {name}, which belongs to {' and '.join(allowed)} alone"


def every_room_has_a_place(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    if path.startswith("fleet/") and path != "fleet/__init__.py" and rank(module_name(path)) is None:
        yield f"{path}: is in no room of ROOMS; give it its place in the order"


def size(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    lines = text.count("\n")
    if lines > 400 and not path.startswith(TABLES):
        yield f"{path}: {lines} lines, the limit is 400; split it by concern"


def name(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    if Path(path).name in BANNED_NAMES:
        yield f"{path}: says nothing; name the file after what is in it"


def arguments(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if any(
            re.search(r"\b(njit|kernel|inlined|bare|making)\b", ast.unparse(decorator))
            for decorator in node.decorator_list
        ):
            continue  # compiled (the other names are njit with options): takes flat numbers and arrays
        if path.startswith("tests/") and node.name.startswith("test_"):
            continue  # pytest fills these in by name
        names = [a.arg for a in (*node.args.posonlyargs, *node.args.args) if a.arg not in ("self", "cls")]
        if len(names) > 5:
            yield f"{path}:{node.lineno}: {node.name} takes {len(names)} positional arguments, the limit is 5"


def docstrings(path: str, tree: ast.Module, text: str) -> Iterator[str]:
    if not path.startswith(PACKAGES):
        return
    for node, is_verb in public(tree):
        where = f"{path}:{getattr(node, 'lineno', 1)}: {getattr(node, 'name', 'the module')}"
        first = (ast.get_docstring(node) or "").split("\n\n")[0]
        if not first:
            yield f"{where} has no docstring"
        elif not re.search(r"[.:](\s|$)", first):
            yield f"{where}: the first sentence of its docstring has no end"
        elif is_verb and not imperative(first.split()[0]):
            yield f"{where}: docstring begins {first.split()[0]!r}, expected an imperative"


def public(tree: ast.Module) -> Iterator[tuple[ast.Module | ast.ClassDef | ast.FunctionDef, bool]]:
    """Everything that needs a docstring, and whether it must begin with an imperative."""
    yield tree, False
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node, True
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield node, False
            for method in node.body:
                if isinstance(method, ast.FunctionDef) and not method.name.startswith("_"):
                    yield method, not any("property" in ast.unparse(d) for d in method.decorator_list)


def imperative(word: str) -> bool:
    bare = word.strip("`'\",.:").lower()
    return bare not in NOT_IMPERATIVE and not (bare.endswith("s") and not bare.endswith(("ss", "us", "is", "as")))


def no_sleep(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    if not path.startswith("tests/"):
        return
    for node in ast.walk(tree):
        called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
        if called.split(".")[-1] in ("sleep", "wait_for_timeout"):
            yield f"{path}:{node.lineno}: sleeps; wait for an event instead"


RULES: tuple[Callable[..., Iterator[str]], ...] = (
    direction,
    alone,
    every_room_has_a_place,
    size,
    name,
    arguments,
    docstrings,
    no_sleep,
)


def sources() -> list[str]:
    return sorted(
        str(path.relative_to(ROOT)) for folder in (*PACKAGES, "tests") for path in (ROOT / folder).rglob("*.py")
    )


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_house_keeps_its_law(rule: Callable[..., Iterator[str]], pytestconfig: pytest.Config) -> None:
    complaints = []
    for path in sources():
        text = (ROOT / path).read_text()
        complaints += rule(path, ast.parse(text), text)
        if rule is size and 250 < text.count("\n") <= 400:
            pytestconfig.stash[LONG_FILES].append(f"{path} ({text.count(chr(10))})")
    assert not complaints, "\n" + "\n".join(complaints)


SHARED = (  # what concealer and finder may both stand on: words, frames, formats; nothing that flies or decides
    *(
        "fleet",
        "fleet.contract",
        "fleet.cli",
        "fleet.process.children",
        "fleet.commands",
        "fleet.frames",
        "fleet.mission",
    ),
    *(
        "fleet.bus.codec",
        "fleet.config",
        "fleet.process.sanitise",
        "fleet.process.logs",
        "fleet.process.interrupt",
        "fleet.process.private_files",
    ),
)
AUTOPILOT = "fleet.autopilots"  # flies the pretend aircraft; the finder has no use for it, but draws beside who has


def reached(*begin: str) -> set[str]:
    """Give every module of ours that these import, and what those import."""
    known = {module_name(path): path for path in sources()}
    found, queue = set(), list(begin)
    while queue:
        name = queue.pop()
        name = name if name in known else name.rpartition(".")[0]  # a name inside a module
        if name in known and name not in found:
            found.add(name)
            tree = ast.parse((ROOT / known[name]).read_text())
            queue += [other for _, other in imported(known[name], tree)] + [name.rpartition(".")[0]]
    return found


def test_finder_and_concealer_share_nothing_that_flies_or_decides() -> None:
    concealer = reached("fleet.blind_test.concealer")
    finder = reached("twin_worker.diagnosis.__main__", "twin_worker.diagnosis.learn")
    assert any(name.startswith("fleet.simulator.conceal") for name in concealer)
    assert {"fleet.effects.icing", "twin_worker.diagnosis.model.simulate"} <= finder | reached("fleet.effects.icing")
    assert not {name for name in concealer & finder if name not in SHARED and not inside(name, AUTOPILOT)}


ALLOWED = (
    (direction, "gateway/a.py", "from fleet.telemetry import intake"),
    (direction, "fleet/telemetry/a.py", "from fleet.contract import Sample\nfrom . import clock"),
    (alone, "gateway/links/link.py", "from pymavlink import mavutil"),
    (arguments, "fleet/a.py", "@nb.njit(cache=True)\ndef f(a, b, c, d, e, g): ..."),
    (arguments, "fleet/a.py", "@inlined\ndef f(a, b, c, d, e, g): ..."),
    (arguments, "fleet/a.py", "class A:\n    def f(self, a, b, c, d, e, *, g): ..."),
    (docstrings, "viewer/a.py", '"""Fine: no verb needed."""\ndef f():\n    """Give a thing."""\ndef _g(): ...'),
)


@pytest.mark.parametrize(("rule", "path", "text"), ALLOWED)
def test_what_is_allowed_is_not_complained_of(rule: Callable[..., Iterator[str]], path: str, text: str) -> None:
    assert not list(rule(path, ast.parse(text), text))


PLANTED = (
    (direction, "gateway/a.py", "from viewer import b"),
    (direction, "fleet/frames.py", "from fleet.contract import Sample"),
    (direction, "fleet/frames.py", "from fleet import bus"),
    (direction, "fleet/telemetry/a.py", "from ..pretend import b"),
    (direction, "fleet/bus/session.py", "import twin_worker.twin.step"),
    (direction, "fleet/simulator/conceal/exam.py", "def f():\n    from fleet.effects import icing"),
    (direction, "fleet/simulator/conceal/plan.py", "import importlib"),
    (direction, "fleet/simulator/faults/physics.py", "from twin_worker.diagnosis.data.card import read"),
    (direction, "twin_worker/diagnosis/name.py", "from fleet.simulator.conceal import hide"),
    (alone, "gateway/a.py", "import zenoh"),
    (alone, "fleet/simulator/flight/uav.py", "from jsbsim import FGFDMExec"),
    (every_room_has_a_place, "fleet/attic.py", ""),
    (size, "viewer/a.py", "x = 1\n" * 401),
    (name, "fleet/telemetry/utils.py", ""),
    (arguments, "viewer/a.py", "def f(a, b, c, d, e, g): ..."),
    (docstrings, "viewer/a.py", "x = 1"),
    (docstrings, "viewer/a.py", '"""Fine."""\ndef f():\n    """Returns a thing."""'),
    (docstrings, "viewer/a.py", '"""Fine."""\nclass A:\n    """No end"""'),
    (docstrings, "viewer/a.py", '"""Fine."""\nclass A:\n    """A thing."""\n    def f(self): ...'),
    (no_sleep, "tests/a.py", "import time\ntime.sleep(1)"),
)


@pytest.mark.parametrize(("rule", "path", "text"), PLANTED)
def test_a_planted_breach_is_found(rule: Callable[..., Iterator[str]], path: str, text: str) -> None:
    assert list(rule(path, ast.parse(text), text))
