"""What another local user could have written is neither run nor believed: caches, keys, certificates."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

import fleet
from fleet.access.papers import check_private as secret
from fleet.blind_test.seal import consume_key, encrypt
from fleet.health import machine
from fleet.process import private_files
from gateway.onboard.parameter_cache_check import Cache, CachedAircraft
from tests.bench.security import planted

CACHES = ("NUMBA_CACHE_DIR", "PARAUAV_CACHE", "XDG_CACHE_HOME", "HOME", "TMPDIR")


def started(said: str = "print(__import__('os').environ['NUMBA_CACHE_DIR'])", **env: object) -> tuple[int, str, str]:
    """Import the package in a process of its own with these settings alone."""
    given = {name: value for name, value in os.environ.items() if name not in CACHES}
    given |= {name: str(value) for name, value in env.items()}
    code = f"import fleet; {said}"
    told = subprocess.run(
        [sys.executable, "-c", code], env=given, cwd=ROOT, capture_output=True, text=True, check=False
    )
    return told.returncode, told.stdout.strip(), told.stderr


@pytest.mark.parametrize("attempt", planted.BY_PLANTING, ids=lambda one: one.__name__)
def test_nothing_planted_is_run_or_believed(attempt) -> None:
    assert attempt()


def test_the_compile_cache_is_in_the_user_s_own_folder_for_the_owner_alone(tmp_path: Path) -> None:
    code, out, _ = started(HOME=tmp_path, TMPDIR=tmp_path)
    found = Path(out)
    assert code == 0 and found == tmp_path / ".cache" / "parauav" / f"numba-{fleet.SOURCES}"
    assert found.stat().st_mode & 0o777 == found.parent.stat().st_mode & 0o777 == 0o700
    assert started(HOME=tmp_path, XDG_CACHE_HOME=tmp_path / "x")[1].startswith(str(tmp_path / "x" / "parauav"))


@pytest.mark.parametrize("home", ["/dev/null", "/proc/self", "relative"])
def test_without_a_home_to_write_to_a_fresh_private_folder_is_used_and_removed(home: str, tmp_path: Path) -> None:
    look = "import os; p = os.environ['NUMBA_CACHE_DIR']; print(p, oct(os.stat(p).st_mode)); print(fleet.CACHE_NOTE)"
    code, out, _ = started(look, HOME=home, TMPDIR=tmp_path)
    place, mode = out.split("\n")[0].split()
    assert code == 0 and Path(place).parent == tmp_path and mode == "0o40700"
    assert "every start compiles" in out and not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["NUMBA_CACHE_DIR", "PARAUAV_CACHE"])
def test_a_folder_the_user_names_is_honoured_and_checked(name: str, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    code, out, _ = started(**{name: mine, "HOME": tmp_path})
    assert code == 0 and Path(out).is_relative_to(mine)
    mine.chmod(0o755)  # as systemd makes it
    assert started(**{name: mine, "HOME": tmp_path})[:2] == (0, out)
    mine.chmod(0o775)
    code, out, errors = started(**{name: mine, "HOME": tmp_path})
    assert code == 2 and not out and "Traceback" not in errors
    assert f"{name} {mine}: found mode 0775, expected" in errors and f"chmod go-w {mine}" in errors


def test_a_folder_below_one_that_others_may_change_is_refused_where_it_is_not_sticky(tmp_path: Path) -> None:
    above = tmp_path / "above"
    below = private_files.ensure_private_folder(above / "below", "cache")
    assert below.stat().st_mode & 0o777 == 0o700
    above.chmod(0o777)
    with pytest.raises(ValueError, match="above with mode 0777"):
        private_files.ensure_private_folder(below, "cache")
    above.chmod(0o1777)
    assert private_files.ensure_private_folder(below, "cache") == below


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_what_belongs_to_another_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = tmp_path / "other"
    other.mkdir(mode=0o700)
    os.chown(other, 12345, 12345)
    assert "owner 12345, expected 0" in private_files.tampering_risk(other)
    key = tmp_path / "key"
    encrypt(b"words", tmp_path / "sealed", key)
    os.chown(key, 12345, 12345)
    with pytest.raises(ValueError, match="owner 12345"):
        consume_key(key)
    monkeypatch.setattr(os, "geteuid", lambda: 54321)
    with pytest.raises(ValueError, match="owner 12345, expected 54321"):
        secret(key)


def test_a_key_is_written_anew_for_its_owner_alone_and_leaves_the_disk_when_taken(tmp_path: Path) -> None:
    victim, key = tmp_path / "victim", tmp_path / "key"
    victim.write_text("mine")
    key.symlink_to(victim)
    encrypt(b"words", tmp_path / "sealed", key)
    assert victim.read_text() == "mine" and key.lstat().st_mode & 0o777 == 0o600
    assert len(consume_key(key)) == 44 and not key.exists()
    key.write_bytes(b"k" * 44)
    key.chmod(0o644)
    with pytest.raises(ValueError, match="found mode 0644"):
        consume_key(key)


def test_doctor_says_of_caches_what_is_wrong_with_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache, told = tmp_path / "cache", tmp_path / "told"
    Cache(told).store("a", CachedAircraft({"P": 1.0}))
    cache.mkdir(mode=0o700)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    monkeypatch.setenv("PARAUAV_ONBOARD", str(told))
    monkeypatch.setattr(fleet, "CACHE_NOTE", "")
    grades = {one.what: one.grade for one in (machine.compile_cache(), *machine.onboard_cache())}
    assert grades == {"compile cache": "ok", "onboard cache": "ok"}
    for folder in (cache, told):
        folder.chmod(0o777)
    bad = [machine.compile_cache(), *machine.onboard_cache()]
    assert [one.grade for one in bad] == ["BAD", "BAD"] and all("chmod go-w" in one.sentence for one in bad)
