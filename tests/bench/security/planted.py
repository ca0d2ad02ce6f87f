"""Another local user plants code or words where this user's processes look: nothing of it is run or believed.

Without a second user at hand the planting is done by permissions: a folder anybody may write to stands for his.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gateway.onboard.parameter_cache_check import Cache, CachedAircraft

ROOT = Path(__file__).resolve().parents[3]
_PROGRAM = """
import fleet, numba, os
@numba.njit(cache=True)
def f(x):
    return x + 1
print(f(1), os.environ["NUMBA_CACHE_DIR"])
"""


@contextmanager
def _program() -> Iterator[tuple[Path, dict[str, str]]]:
    """Give a program with a compiled function and its surroundings: a home and a shared folder, nothing named."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "home").mkdir(mode=0o700)
        (folder / "shared").mkdir()
        (folder / "shared").chmod(0o1777)
        (folder / "program.py").write_text(_PROGRAM)
        env = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "PARAUAV_CACHE", "XDG_CACHE_HOME")}
        yield folder, env | {"HOME": f"{folder}/home", "TMPDIR": f"{folder}/shared", "PYTHONPATH": str(ROOT)}


def _run(folder: Path, env: dict[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(folder / "program.py")]
    return subprocess.run(command, env=env, capture_output=True, text=True, check=False)


def _poison(cache: Path, proof: Path) -> int:
    """Replace every index numba would unpickle by one that leaves a proof of having been run."""
    found = list(cache.rglob("*.nbi"))
    for path in found:
        path.write_bytes(b"cposix\nsystem\n(S'touch " + str(proof).encode() + b"'\ntR.")
    return len(found)


def code_in_the_shared_folder() -> str:
    """A compile cache made ready at the predictable place under the temporary directory."""
    with _program() as (folder, env):
        proof, old = folder / "proof", folder / "shared" / f"parauav-{os.getuid()}"
        first = _run(folder, env)
        assert first.returncode == 0 and first.stdout.startswith("2 "), first.stderr
        cache = Path(first.stdout.split()[1])
        named = old / cache.name
        if not named.exists():
            shutil.copytree(cache, named)
        assert _poison(named, proof), "nothing to poison"
        again = _run(folder, env)
        assert again.returncode == 0 and again.stdout.startswith("2 "), again.stderr
        assert not proof.exists(), "planted code was run"
        assert not cache.is_relative_to(folder / "shared") and cache.stat().st_mode & 0o777 == 0o700
        assert list(cache.rglob("*.nbc")), "the rightful cache is used"
        return "not looked at; the user's own cache is used"


def code_in_a_folder_anybody_writes() -> str:
    """A compile cache the user names, in a folder where everybody may write."""
    with _program() as (folder, env):
        mine, proof = folder / "named", folder / "proof"
        first = _run(folder, env | {"PARAUAV_CACHE": str(mine)})
        assert first.returncode == 0 and first.stdout.startswith("2 "), first.stderr
        assert _poison(mine, proof), "nothing to poison"
        mine.chmod(0o777)
        refused = _run(folder, env | {"PARAUAV_CACHE": str(mine)})
        assert not proof.exists(), "planted code was run"
        assert refused.returncode == 2 and "chmod go-w" in refused.stderr, refused.stderr
        return refused.stderr.strip().replace(str(folder), "…")


def words_in_the_onboard_cache() -> str:
    """Parameters of an aircraft, planted where anybody may write."""
    with tempfile.TemporaryDirectory() as name:
        told = Path(name) / "told"
        Cache(told).store("px4-1-1", CachedAircraft({"FW_AIRSPD_TRIM": 15.0}))
        assert Cache(told).read("px4-1-1") is not None, "what was kept is found again"
        told.chmod(0o777)
        (told / "px4-1-1.json").write_text('{"values": {"FW_AIRSPD_TRIM": 99.0}}')
        assert Cache(told).read("px4-1-1") is None, "planted parameters were believed"
        return "not read; kept and found again in a folder of one's own"


BY_PLANTING = (code_in_the_shared_folder, code_in_a_folder_anybody_writes, words_in_the_onboard_cache)
