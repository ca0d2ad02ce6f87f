"""Other people's linear identification on scaled data, as functions (y, u, order) -> A, B, C, D.

All are optional: `nfoursid`, `sippy_unipi` (not `sippy`, which is a telephone), `jax-sysid`; SLICOT's moen4 comes with
Octave and its control package. D is theirs to use.
"""

import contextlib
import importlib.util
import io
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.io


class Found(NamedTuple):
    """What a peer made of the data: x' = A x + B u, y = C x + D u."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


Peer = Callable[[np.ndarray, np.ndarray, int], Found]
_ROWS = 15  # block rows [samples]


def nfoursid(y: np.ndarray, u: np.ndarray, order: int) -> Found:
    import pandas
    from nfoursid.nfoursid import NFourSID

    names = [f"y{i}" for i in range(y.shape[1])], [f"u{i}" for i in range(u.shape[1])]
    method = NFourSID(pandas.DataFrame(np.hstack([y, u]), columns=names[0] + names[1]), *names, num_block_rows=_ROWS)
    method.subspace_identification()
    found = method.system_identification(rank=order)[0]
    return Found(found.a, found.b, found.c, found.d)


def sippy(name: str, feedthrough: bool) -> Peer:
    def identify(y: np.ndarray, u: np.ndarray, order: int) -> Found:
        from sippy_unipi import system_identification

        options = {"SS_f": _ROWS, "SS_p": _ROWS, "SS_D_required": feedthrough}
        found = system_identification(y.T, u.T, name, SS_fixed_order=order, **options)
        return Found(*(np.asarray(m, float) for m in (found.A, found.B, found.C, found.D)))

    return identify


def jax_sysid(y: np.ndarray, u: np.ndarray, order: int) -> Found:
    import jax

    jax.config.update("jax_enable_x64", True)
    from jax_sysid.models import LinearModel

    model = LinearModel(order, y.shape[1], u.shape[1], feedthrough=False, y_in_x=False)
    model.loss(rho_x0=1e-4, rho_th=1e-4)
    model.optimization(adam_epochs=500, lbfgs_epochs=1000, iprint=-1)
    model.fit(y, u)
    return Found(*(np.asarray(m) for m in model.ssdata()))


_OCTAVE = """
pkg load control
load('in.mat');
try
  [sys, x0] = moen4(iddata(y, u, 1), double(order), 's', double(rows));
  [A, B, C, D] = ssdata(sys);
  save('-v7', 'out.mat', 'A', 'B', 'C', 'D');
end_try_catch
"""


def moen4(y: np.ndarray, u: np.ndarray, order: int) -> Found:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scipy.io.savemat(folder / "in.mat", {"y": y, "u": u, "order": order, "rows": max(_ROWS, order + 1)})
        (folder / "run.m").write_text(_OCTAVE)
        subprocess.run(
            ["octave-cli", "--no-gui", "--norc", "run.m"], cwd=folder, capture_output=True, check=False, timeout=120
        )
        if not (folder / "out.mat").exists():
            raise ValueError("moen4: Octave gave no model")
        found = scipy.io.loadmat(folder / "out.mat")
    return Found(*(found[key].astype(float) for key in Found._fields))


def peers() -> dict[str, tuple[Peer, ...]]:
    """Name the peers that are installed here; each with the variants it may choose from."""
    found: dict[str, tuple[Peer, ...]] = {}
    if importlib.util.find_spec("nfoursid"):
        found["nfoursid"] = (nfoursid,)
    if importlib.util.find_spec("sippy_unipi"):
        for name in ("N4SID", "MOESP", "CVA", "PARSIM-K"):  # PARSIM-P and PARSIM-S crash on some sets
            found[f"sippy {name}"] = (sippy(name, False), sippy(name, True))
    if importlib.util.find_spec("jax_sysid"):
        found["jax-sysid"] = (jax_sysid,)
    if shutil.which("octave-cli"):
        found["moen4"] = (moen4,)
    return found


@contextlib.contextmanager
def quietly():
    """Keep their prints and warnings off the screen, and their sys.exit from ending ours."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            yield
        except SystemExit as error:
            raise ValueError("the peer tried to end the process") from error
