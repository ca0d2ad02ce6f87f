"""ParaUAV: a fleet of digital twins for UAV swarms (what every process shares)."""

from fleet import interrupt as interrupt  # first: from here on it handles Ctrl-C

# isort: split
import hashlib
import os
import tempfile
from pathlib import Path

__version__ = "0.1.0"


def _sources_hash() -> str:
    """Hash every source file of the four packages, so that an edit anywhere renews the compile cache.

    numba's own cache looks at one file only and silently returns the old answer after an edit in another.
    """
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for package in ("fleet", "gateway", "twin_worker", "viewer"):
        for source in sorted((root / package).rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


SOURCES = _sources_hash()


def _name_compile_cache() -> None:
    base = os.environ.get("PARAUAV_CACHE") or Path(tempfile.gettempdir()) / f"parauav-{os.getuid()}"
    os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(base) / f"numba-{SOURCES}"))


_name_compile_cache()
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # small matrices: BLAS threads cost 10-50 times on a busy machine
