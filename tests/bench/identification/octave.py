"""SLICOT's moen4 by way of Octave's control package: one Octave process, asked again and again."""

import shutil
import subprocess
import tempfile
import weakref
from functools import cache
from pathlib import Path

import numpy as np
import scipy.io

_COMMAND = ("octave", "--no-gui", "--quiet", "--norc", "--no-window-system")
_BLOCK_ROWS = 12
_SCRIPT = """
try
 load('{asked}'); t = cputime; [s, x0, info] = moen4(iddata(y, u, dt), n, 's', {rows}); ms = 1000 * (cputime - t);
 [A, B, C, D] = ssdata(s); K = info.K; save('-v6', '{answer}', 'A', 'B', 'C', 'D', 'K', 'ms'); disp('DONE');
catch trouble
 disp(['FAILED ' strrep(trouble.message, "\\n", ' ')]);
end
"""


@cache
def absent() -> str:
    """Say why moen4 cannot be asked; empty where it can."""
    if shutil.which(_COMMAND[0]) is None:
        return "found no octave; on Debian: apt-get install octave octave-control; skipped"
    done = subprocess.run([*_COMMAND, "--eval", "pkg load control; which moen4"], capture_output=True, text=True)
    return "" if "moen4" in done.stdout else "found octave without its control package, install it; skipped"


class Octave:
    """A running Octave; it starts with the first question, and again should it have died."""

    def __init__(self) -> None:
        self._folder = Path(tempfile.mkdtemp())
        self._process: subprocess.Popen[str] | None = None
        weakref.finalize(self, shutil.rmtree, self._folder)

    def moen4(self, y: np.ndarray, u: np.ndarray, dt: float, order: int) -> dict[str, np.ndarray]:
        """Identify; give A B C D K and ms, the processor time it took [ms].

        Raises:
            RuntimeError: when moen4 or Octave fails.
        """
        asked, answer = (self._folder / name for name in ("asked.mat", "answer.mat"))
        scipy.io.savemat(asked, {"y": y, "u": u, "dt": dt, "n": float(order)})
        said = self._ask(_SCRIPT.format(asked=asked, answer=answer, rows=_BLOCK_ROWS))
        if said != "DONE":
            raise RuntimeError(said.removeprefix("FAILED "))
        found = scipy.io.loadmat(answer)
        return {name: found[name] for name in ("A", "B", "C", "D", "K", "ms")}

    def _ask(self, script: str) -> str:
        if self._process is None or self._process.poll() is not None:
            pipe, quiet = subprocess.PIPE, subprocess.DEVNULL
            self._process = subprocess.Popen(_COMMAND, stdin=pipe, stdout=pipe, stderr=quiet, text=True)
            weakref.finalize(self, _stop, self._process)
            script = "pkg load control; warning('off', 'all');" + script
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None and stdout is not None
        stdin.write(script)
        stdin.flush()
        for line in stdout:
            if line.startswith(("DONE", "FAILED")):
                return line.strip()
        raise RuntimeError("octave has died")


def _stop(process: subprocess.Popen[str]) -> None:
    """End it and everything that leads to it."""
    process.kill()
    process.communicate()
