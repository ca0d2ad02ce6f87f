"""ParaUAV: a fleet of digital twins for UAV swarms (code shared by all processes)."""

from fleet.process import interrupt as interrupt  # first, so that Ctrl-C is handled from here on

# isort: split

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

from fleet.process import private_files

__version__ = "0.1.0"
_CACHE_EXPIRY_S = 30 * 86_400  # age at which the compile cache of other sources is removed [s]


def _sources_hash() -> str:
    """Hash every source file of the four packages, so that any edit invalidates the compile cache.

    numba's own cache checks one file only and silently returns old code after an edit in another.
    """
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for package in ("fleet", "gateway", "twin_worker", "viewer"):
        for source in sorted((root / package).rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


SOURCES = _sources_hash()


def _compile_cache() -> tuple[Path, str]:
    """Select the folder of compiled functions. numba unpickles them, so write access there is code execution.

    Returns:
        the folder, writable by this user only; a note for `fleet doctor`, or empty
    Raises:
        ValueError: when the configured folder is writable by others.
        OSError: when it cannot be created.
    """
    if configured := os.environ.get("NUMBA_CACHE_DIR"):
        return private_files.ensure_private_folder(Path(configured).absolute(), "NUMBA_CACHE_DIR"), ""
    if configured := os.environ.get("PARAUAV_CACHE"):
        return _sources_folder(private_files.ensure_private_folder(Path(configured).absolute(), "PARAUAV_CACHE")), ""
    try:
        default = private_files.cache_folder()
        private_files.ensure_private_folder(default, "cache")
        private_files.restrict_to_owner(default)
        return _sources_folder(default), ""
    except (ValueError, OSError, RuntimeError) as error:
        temporary = Path(tempfile.mkdtemp(prefix="parauav-cache-"))
        atexit.register(_remove_if_owner, temporary, os.getpid())
        return temporary, f"the user's cache folder is not usable ({error}), so every start compiles; see PARAUAV_CACHE"


def _sources_folder(base: Path) -> Path:
    """Return the private cache folder of the current sources; when it is new, remove expired folders of others."""
    cache = base / f"numba-{SOURCES}"
    if not cache.exists():
        for old in base.glob("numba-*"):
            if time.time() - old.lstat().st_mtime > _CACHE_EXPIRY_S:
                shutil.rmtree(old, ignore_errors=True)
    private_files.ensure_private_folder(cache, "compile cache")
    private_files.restrict_to_owner(cache)
    os.utime(cache)
    return cache


def _remove_if_owner(folder: Path, pid: int) -> None:
    if os.getpid() == pid:
        shutil.rmtree(folder, ignore_errors=True)


try:
    _folder, CACHE_NOTE = _compile_cache()
except (ValueError, OSError) as _error:
    _reason = (
        str(_error) if isinstance(_error, ValueError) else f"compile cache: found {_error}, expected a writable folder"
    )
    print(f"{_reason}; or leave NUMBA_CACHE_DIR and PARAUAV_CACHE unset", file=sys.stderr, flush=True)
    raise SystemExit(2) from None
os.environ["NUMBA_CACHE_DIR"] = str(_folder)
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # small matrices: BLAS threads cost 10-50 times on a busy machine
