"""Read files, each in a child of one process that has the readers loaded and compiled; see `hostile_files`.

A request a line: path, column map, CPU time [s] and memory [bytes] at most. An answer a line, JSON.
"""

import fleet

# isort: split

import json
import os
import resource
import sys
from typing import Any, NoReturn

import scipy.io  # noqa: F401  for tables of MATLAB, as the next for bags: loading is no part of what a file costs

import fleet.telemetry.onboard_logs.ros2.reader  # noqa: F401
from fleet.telemetry.mavlink.warm import warm_up
from fleet.telemetry.recording.options import RecordingOptions
from fleet.telemetry.recording.recordings import Recording
from tests.bench.peak_memory import peak_mb, reset_peak


def read(loaded_mb: float, path: str, columns: str) -> dict[str, Any]:
    """Read a file; give CPU time [s], memory at most [MB], messages, and what was said of it.

    Libraries loaded by the parent are not resident in a child before it uses them: the parent counts them.
    """
    before_mb = reset_peak()
    begun = resource.getrusage(resource.RUSAGE_SELF)
    said, news = "", 0
    try:
        recording = Recording(path, options=RecordingOptions(columns=columns))
        for _, heard in recording.steps():
            news += len(heard)
        said = "; ".join(recording.skipped)
    except (ValueError, OSError) as error:
        said = str(error)
    ended = resource.getrusage(resource.RUSAGE_SELF)
    cpu = ended.ru_utime + ended.ru_stime - begun.ru_utime - begun.ru_stime
    return {"cpu_s": cpu, "mb": loaded_mb + peak_mb() - before_mb, "news": news, "said": said}


def read_within(out: int, loaded_mb: float, request: tuple[str, str, int, int]) -> NoReturn:
    """Read a file within bounds, write the answer, and end the process."""
    path, columns, cpu_s, memory = request
    code = 1
    try:
        resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
        os.write(out, json.dumps(read(loaded_mb, path, columns)).encode())
        code = 0
    except BaseException as error:
        os.write(out, json.dumps({"died": f"{type(error).__name__}: {error}"}).encode())
    finally:
        os._exit(code)


def main() -> None:
    """Answer requests until there are no more."""
    warm_up()
    loaded_mb = reset_peak()
    for line in sys.stdin:
        answers, out = os.pipe()
        child = os.fork()
        if not child:
            read_within(out, loaded_mb, json.loads(line))
        os.close(out)
        with open(answers, "rb") as pipe:
            answer = json.loads(pipe.read() or "{}")
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps(answer | {"code": code}), flush=True)


if __name__ == "__main__":
    main()
