"""Architecture rules read off the source: import order, sizes, docstrings, names."""

import ast
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from pathlib import Path

import pytest
from conftest import LONG_FILES, ROOT

PACKAGES = ("fleet", "gateway", "twin_worker", "viewer")

ORDER = (  # a folder, or a module in the root of a package, imports only from itself and from those on lines above
    ("fleet.process", "fleet.compiled_frames"),
    ("fleet", "fleet.frames", "fleet.vehicles", "fleet.commands"),
    ("fleet.contract",),
    ("fleet.mission_jumps", "fleet.mission_legs"),
    ("fleet.metrics", "fleet.mission", "fleet.window", "fleet.access"),
    ("fleet.config", "fleet.bus", "fleet.cli"),
    ("fleet.airframes", "fleet.autopilots.control_law", "fleet.terrain"),
    ("fleet.autopilots.arduplane",),
    ("fleet.autopilots.px4_fixedwing", "fleet.autopilots.textbook"),
    ("fleet.autopilots",),
    ("fleet.physics",),
    ("fleet.effects",),
    ("fleet.telemetry",),
    ("fleet.telemetry.tables",),
    ("fleet.telemetry.mavlink.parsing", "fleet.telemetry.mavlink.microservices", "fleet.telemetry.mavlink.arrays"),
    ("fleet.telemetry.mavlink",),
    ("fleet.telemetry.onboard_logs",),
    ("fleet.telemetry.onboard_logs.dataflash", "fleet.telemetry.onboard_logs.ulog"),
    ("fleet.telemetry.onboard_logs.columns", "fleet.telemetry.onboard_logs.ros2"),
    ("fleet.telemetry.recording",),
    ("fleet.telemetry.replay", "fleet.telemetry.inspection"),
    ("fleet.report",),
    ("fleet.simulator",),
    ("fleet.simulator.vehicle",),
    ("fleet.simulator.faults",),
    ("fleet.simulator.flight",),
    ("fleet.simulator.multirotor",),
    ("fleet.simulator.conceal",),
    ("fleet.blind_test", "fleet.health", "fleet.export"),
    ("fleet.commands.live", "fleet.commands.control", "fleet.commands.offline"),
    ("gateway",),
    ("gateway.link_spec",),
    ("gateway.admission",),
    ("gateway.links",),
    ("gateway.record",),
    ("gateway.onboard",),
    ("gateway.publication", "gateway.forwarding", "gateway.commands"),
    ("gateway.status",),
    ("gateway.pipeline",),
    ("gateway.__main__",),
    ("twin_worker",),
    ("twin_worker.numerics",),
    ("twin_worker.telemetry",),
    ("twin_worker.estimation",),
    ("twin_worker.identification",),
    ("twin_worker.identification.linear",),
    ("twin_worker.identification.fixed_wing",),
    ("twin_worker.validation",),
    ("twin_worker.confidence",),
    ("twin_worker.confidence.calibration",),
    ("twin_worker.prediction",),
    ("twin_worker.prediction.fixed_wing", "twin_worker.prediction.multirotor"),
    ("twin_worker.alerts",),
    ("twin_worker.diagnosis.data",),
    ("twin_worker.diagnosis.model",),
    ("twin_worker.diagnosis.inference.isolation",),
    ("twin_worker.diagnosis.inference.validation",),
    ("twin_worker.diagnosis.inference",),
    ("twin_worker.diagnosis.baseline", "twin_worker.diagnosis.multirotor"),
    ("twin_worker.diagnosis.output",),
    ("twin_worker.diagnosis",),
    ("twin_worker.twin.state",),
    ("twin_worker.twin.steps",),
    ("twin_worker.twin",),
    ("twin_worker.mismatch", "twin_worker.whatif", "twin_worker.ownership"),
    ("twin_worker.proposals",),
    ("twin_worker.service",),
    ("twin_worker.evaluation.scoring", "twin_worker.evaluation.baselines"),
    ("twin_worker.evaluation", "twin_worker.paper_experiments"),
    ("twin_worker.__main__",),
    ("viewer",),
    ("viewer.theme",),
    ("viewer.store",),
    ("viewer.text", "viewer.scene.map"),
    ("viewer.browser",),
    ("viewer.panels", "viewer.scene"),
    ("viewer.scene.selection", "viewer.scene.terrain"),
    ("viewer.timeline",),
    ("viewer.export",),
    ("viewer.server",),
    ("viewer.__main__",),
)
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}

ALONE = {  # a foreign library, and the only places that may import it
    "zenoh": ("fleet/bus/session.py",),
    "viser": ("viewer/",),
    "jsbsim": ("fleet/simulator/vehicle/jsbsim.py",),
    "rotorpy": ("fleet/simulator/multirotor/rigid_body.py",),
    "pymavlink": (
        "fleet/telemetry/",
        "fleet/simulator/flight/mavlink",
        "fleet/simulator/flight/mission_server.py",
        "fleet/simulator/multirotor/messages.py",
        "gateway/",
    ),
}

APART = (  # who, and what it must never import
    ("fleet", ("gateway", "twin_worker", "viewer")),
    ("gateway", ("twin_worker", "viewer")),
    ("twin_worker", ("gateway", "viewer", "fleet.simulator")),
    ("viewer", ("gateway", "twin_worker", "fleet.simulator")),
    ("fleet.simulator", ("fleet.physics", "fleet.effects")),  # never our own physics
    ("fleet.simulator.multirotor", ("fleet.autopilots", "fleet.mission")),  # nor the law and route that predict it
    ("fleet.simulator", ("importlib", "runpy", "subprocess")),  # nor by the back door
    ("fleet.effects", ("fleet.simulator",)),  # one code must never both conceal and find
    ("fleet.physics.simulate", ("fleet.simulator",)),
    ("twin_worker.diagnosis", ("fleet.simulator", "fleet.blind_test")),
    ("fleet.blind_test", ("fleet.physics", "fleet.effects", "fleet.physics.simulate", "fleet.physics.point_mass")),
)

MOST_FILES = 12  # Python files directly in one folder
TABLE_FOLDERS = ("fleet/effects", "fleet/telemetry/tables")
TABLES = ("fleet/contract.py", "fleet/telemetry/tables/")  # data, so they may be long
BANNED_NAMES = ("utils.py", "helpers.py", "common.py", "misc.py")
NOT_IMPERATIVE = {"a", "an", "the", "this", "it", "returns", "gets", "function", "method"}


# --- reading ---------------------------------------------------------------------------------------------------------


def module_name(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@lru_cache(maxsize=1)
def nodes(tree: ast.AST) -> list[ast.AST]:
    """Every node, which all rules go through in turn."""
    return list(ast.walk(tree))


def imported(path: str, tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Every module a file imports: (line, dotted name), relative ones made absolute."""
    parts = module_name(path).split(".")
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            up = node.level - path.endswith("__init__.py") if node.level else 0
            base = ".".join(parts[: len(parts) - up]) if node.level else ""
            name = ".".join(filter(None, (base, node.module)))
            yield from ((node.lineno, f"{name}.{alias.name}") for alias in node.names)


def inside(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def home(name: str) -> str | None:
    """The folder of ORDER that a module belongs to, or the root module itself."""
    known = name
    while known and known not in RANK:
        known = known.rpartition(".")[0]
    return known or None


# --- the rules: (path, tree, text) -> complaints ---------------------------------------------------------------------


def direction(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    me = module_name(path)
    for line, name in imported(path, tree):
        for who, never in APART:
            if inside(me, who) and any(inside(name, other) for other in never):
                yield f"{path}:{line}: {who} imports {name}; it may not, turn the dependency round"
        mine, theirs = home(me), home(name)
        if mine and theirs and mine != theirs and RANK[theirs] >= RANK[mine] and theirs not in PACKAGES:
            yield f"{path}:{line}: {mine} imports {name} of {theirs}, which comes later; move what is shared up"


def alone(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    for line, name in imported(path, tree):
        allowed = ALONE.get(name.split(".")[0])
        if allowed and path.startswith(PACKAGES) and not path.startswith(allowed):
            yield f"{path}:{line}: imports {name}, which belongs to {' and '.join(allowed)} alone"


def has_a_place(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    if path.startswith(PACKAGES) and not path.endswith("__init__.py") and home(module_name(path)) in (None, *PACKAGES):
        yield f"{path}: is in no line of ORDER; add its folder"


def size(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    lines = text.count("\n")
    if lines > 400 and not path.startswith(TABLES):
        yield f"{path}: {lines} lines, the limit is 400; split it by concern"


def crowded(paths: Iterable[str]) -> Iterator[str]:
    """Complain of folders with too many files of their own."""
    paths = [path for path in paths if path.startswith(PACKAGES) or Path(path).name.startswith("test_")]
    count = Counter(path.rpartition("/")[0] for path in paths)
    for folder, files in sorted(count.items()):
        if files > MOST_FILES and folder not in TABLE_FOLDERS:
            yield f"{folder}: {files} files, the limit is {MOST_FILES}; group some of them in a subfolder"


def mirrored(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    """Test files lie in a folder named like the product folder they test, or in the root where they test the whole."""
    folder = path.removeprefix("tests/").rpartition("/")[0]
    if path.startswith("tests/") and Path(path).name.startswith("test_") and folder and not (ROOT / folder).is_dir():
        yield f"{path}: there is no folder {folder}; put it where what it tests is"


def name(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    if Path(path).name in BANNED_NAMES:
        yield f"{path}: says nothing; name the file after what is in it"


def arguments(path: str, tree: ast.AST, text: str) -> Iterator[str]:
    for node in nodes(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if any(
            re.search(r"\b(njit|\w*kernel|inlined|bare|making)\b", ast.unparse(decorator))
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
    for node in nodes(tree):
        called = node.func if isinstance(node, ast.Call) else None
        if getattr(called, "attr", getattr(called, "id", "")) in ("sleep", "wait_for_timeout"):
            yield f"{path}:{node.lineno}: sleeps; wait for an event instead"


RULES: tuple[Callable[..., Iterator[str]], ...] = (
    *(direction, alone, has_a_place, size, mirrored),
    *(name, arguments, docstrings, no_sleep),
)


def sources() -> list[str]:
    return sorted(
        str(path.relative_to(ROOT)) for folder in (*PACKAGES, "tests") for path in (ROOT / folder).rglob("*.py")
    )


@pytest.fixture(scope="module")
def complaints(pytestconfig: pytest.Config) -> dict[str, list[str]]:
    """What each rule says of all sources, each read and parsed once."""
    found: dict[str, list[str]] = {rule.__name__: [] for rule in RULES}
    for path in sources():
        text = (ROOT / path).read_text()
        tree = ast.parse(text)
        for rule in RULES:
            found[rule.__name__] += rule(path, tree, text)
        if 250 < text.count("\n") <= 400:
            pytestconfig.stash[LONG_FILES].append(f"{path} ({text.count(chr(10))})")
    return found


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_every_source_file_keeps_the_rule(rule: Callable[..., Iterator[str]], complaints: dict[str, list[str]]) -> None:
    assert not complaints[rule.__name__], "\n" + "\n".join(complaints[rule.__name__])


def test_no_folder_is_crowded() -> None:
    assert not list(crowded(sources()))
    assert list(crowded(f"viewer/scene/m{k}.py" for k in range(MOST_FILES + 1)))
    assert not list(crowded(f"fleet/effects/m{k}.py" for k in range(MOST_FILES + 1)))


SHARED = (  # what concealer and finder may both stand on: words, frames, formats; nothing that flies or decides
    *(f"fleet.{n}" for n in ("contract", "cli", "process", "commands", "frames", "compiled_frames", "config", "bus")),
    *("fleet", "fleet.mission", "fleet.mission_jumps", "fleet.mission_legs", "fleet.simulator", "fleet.bus.codec"),
    *(f"fleet.process.{n}" for n in ("sanitise", "logs", "children", "interrupt", "private_files", "file_options")),
)
READERS = ("fleet.telemetry", "fleet.airframes", "fleet.vehicles", "fleet.window", "fleet.metrics", "fleet.access")
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


@pytest.mark.parametrize(("begin", "allowed"), [("concealer", ()), ("inject.injector", READERS)])
def test_finder_and_concealer_share_nothing_that_flies_or_decides(begin: str, allowed: tuple[str, ...]) -> None:
    concealer = reached(f"fleet.blind_test.{begin}")
    finder = reached(*(f"twin_worker.diagnosis.{name}" for name in ("__main__", "learn")))
    assert any(inside(n, "fleet.simulator.conceal") or inside(n, "fleet.blind_test.inject.thrust") for n in concealer)
    assert {"fleet.effects.icing", "twin_worker.diagnosis.model.simulate"} <= finder | reached("fleet.effects.icing")
    assert all(n in SHARED or any(inside(n, x) for x in (AUTOPILOT, *allowed)) for n in concealer & finder)


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
    (direction, "fleet/telemetry/a.py", "from ..simulator.flight import b"),
    (direction, "twin_worker/numerics/a.py", "from twin_worker.telemetry import history"),
    (direction, "twin_worker/twin/state/a.py", "from twin_worker.twin.step import advance"),
    (direction, "gateway/links/a.py", "from gateway.pipeline import Pump"),
    (direction, "viewer/store/a.py", "def f():\n    from viewer.panels import charts"),
    (direction, "fleet/bus/session.py", "import twin_worker.twin.step"),
    (direction, "fleet/simulator/conceal/exam.py", "def f():\n    from fleet.effects import icing"),
    (direction, "fleet/simulator/conceal/paths.py", "import importlib"),
    (direction, "fleet/simulator/faults/physics.py", "from twin_worker.diagnosis.data.card import read"),
    (direction, "twin_worker/diagnosis/name.py", "from fleet.simulator.conceal import hide"),
    (alone, "gateway/a.py", "import zenoh"),
    (alone, "fleet/simulator/flight/uav.py", "from jsbsim import FGFDMExec"),
    (has_a_place, "fleet/attic.py", ""),
    (size, "viewer/a.py", "x = 1\n" * 401),
    (mirrored, "tests/attic/test_a.py", ""),
    (mirrored, "tests/bench/test_a.py", ""),
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
