"""The project around the house: tracked files, dependencies and their lock, console commands."""

import ast
import functools
import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest
from conftest import ROOT
from test_architecture import PACKAGES, imported, sources

from fleet import cli

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OFFERED = {"msgpack"}  # not imported: the wire format, for tools such as the README's
PEERS = {
    "jax",
    "jax-sysid",
    "nfoursid",
    "pandas",
    "pysindy",
    "sippy-unipi",
}  # of the bench, in an environment of their own
OPTIONAL = {"rerun": "rerun-sdk"}  # package imported where it is installed, and its distribution
TOOLS = {"ruff", "mypy", "pytest", "pytest-xdist"}  # development dependencies that are run rather than imported


# --- tracked files ---------------------------------------------------------------------------------------------------


def tracked() -> list[Path]:
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listing.returncode:
        pytest.skip("not a git checkout, so nothing says which files are the project's")
    return [ROOT / name for name in listing.stdout.split("\0") if name and (ROOT / name).is_file()]


MACHINE = re.compile(rb"(?<![\w.}])/(?:work|home|root|Users)/\w|https?://[^\s\"']*(?:pypi|pythonhosted|npmjs|conda)")


def test_no_machine_path_and_no_registry_is_tracked() -> None:
    assert MACHINE.search(b"see /" + b"home/someone") and MACHINE.search(b"https://" + b"pypi.org/simple")
    found = [(str(path.relative_to(ROOT)), hit[0]) for path in tracked() if (hit := MACHINE.search(path.read_bytes()))]
    assert not found


# --- dependencies ----------------------------------------------------------------------------------------------------


def bare(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9._-]", requirement)[0].lower().replace("_", "-")


@functools.cache
def tops(path: str) -> set[str]:
    """Top names of everything a file imports."""
    return {name.split(".")[0] for _, name in imported(path, ast.parse((ROOT / path).read_text()))}


@functools.cache
def distributions() -> Mapping[str, list[str]]:
    return importlib.metadata.packages_distributions()


def third_party(*folders: str) -> set[str]:
    """Distributions that the sources of some folders import."""
    offered = distributions()
    found: set[str] = set()
    local = {*PACKAGES, "tests", "docs", *(path.stem for path in (ROOT / "tests").rglob("*.py"))}
    for path in sources():
        if path.startswith(folders):
            for top in tops(path) - set(sys.stdlib_module_names) - local:
                if bare(top) in PEERS or top in OPTIONAL:
                    found.add(OPTIONAL.get(top, bare(top)))
                    continue
                assert top in offered, f"{path} imports {top}, which is not installed"
                found |= {bare(offer) for offer in offered[top]}
    return found


def test_every_bench_can_be_imported() -> None:
    """The suite does not run the benches, so that a renamed import in one of them would go unnoticed."""
    files = [path for path in (ROOT / "tests" / "bench").rglob("*.py") if path.name != "__init__.py"]
    code = "import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name)"
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files]
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    done = subprocess.run(
        [sys.executable, "-c", code, *sorted(names)],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert len(names) > 50 and done.returncode == 0, done.stderr[-2000:]


def test_what_is_imported_is_declared_and_what_is_declared_is_imported() -> None:
    run_time = {bare(line) for line in PROJECT["dependencies"]}
    development = {bare(line) for line in PROJECT["optional-dependencies"]["dev"]}
    optional = {bare(line) for extra in ("multirotor", "rerun") for line in PROJECT["optional-dependencies"][extra]}
    assert third_party(*PACKAGES) == (run_time | optional) - OFFERED
    assert {bare(line) for line in PROJECT["optional-dependencies"]["bench"]} == PEERS <= third_party("tests/bench")
    assert third_party("tests") <= run_time | optional | development | PEERS
    assert development <= third_party("tests") | TOOLS


LOCKS = {
    "requirements.lock": "dev",
    "requirements-bench.lock": "bench",
    "requirements-docs.lock": "docs",
    "requirements-rerun.lock": "rerun",
}


@pytest.mark.parametrize(("lock", "extra"), LOCKS.items())
def test_the_lock_holds_every_dependency_by_version_and_hash_and_no_address(lock: str, extra: str) -> None:
    text = (ROOT / lock).read_text()
    assert "http" not in text and "--index" not in text and "--find-links" not in text
    entries = re.split(r"\n(?=[a-z0-9])", text.replace("\\\n", " "))[1:]
    assert all(re.match(r"[a-z0-9._-]+==[^ ]+ +--hash=sha256:[0-9a-f]{64}", entry) for entry in entries), entries
    locked = {entry.split("==")[0] for entry in entries}
    wanted = set(PROJECT["optional-dependencies"][extra])
    if extra in ("dev", "bench"):  # the others are added to what is installed, or need nothing of it
        wanted |= {*PROJECT["dependencies"], "setuptools"}
    assert {bare(line) for line in wanted} <= locked
    assert "cvxopt" not in locked  # GPL; named by rotorpy, whose flight dynamics do not need it
    assert lock != "requirements.lock" or "rotorpy" in locked


# --- commands --------------------------------------------------------------------------------------------------------

VERBS = sorted(cli.command_modules())


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_is_whole_and_its_help_shows_examples(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    module = importlib.import_module(cli.command_modules()[verb])
    assert f"fleet {verb}" in module.EXAMPLES
    assert callable(module.arguments) and callable(module.run)
    with pytest.raises(SystemExit) as left:
        cli.main([verb, "--help"])
    shown = capsys.readouterr().out
    assert left.value.code == 0
    assert "examples:" in shown and module.EXAMPLES.strip() in shown


@pytest.mark.parametrize("command", sorted(PROJECT["scripts"]))
def test_every_console_command_helps_with_examples_and_refuses_nonsense(command: str) -> None:
    module, _, function = PROJECT["scripts"][command].partition(":")
    code = f"""
import sys
from {module} import {function} as main
sys.argv[1:] = ["--help"]
try:
    sys.exit(main())
except SystemExit as left:
    print("left with", left.code)
sys.argv[1:] = ["--no-such-flag"]
sys.exit(main())
"""
    line = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert "examples:" in done.stdout and done.stdout.endswith("left with 0\n"), done.stderr
    assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr
