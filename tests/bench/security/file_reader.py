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

import scipy.io  # noqa: F401  MATLAB tables; loading libraries is not part of the cost of a file

import fleet.telemetry.onboard_logs.ros2.reader  # noqa: F401
from fleet.telemetry.mavlink.warm import warm_up
from fleet.telemetry.recording.options import RecordingOptions
from fleet.telemetry.recording.recordings import Recording
from tests.bench.peak_memory import peak_mb, reset_peak


def read(loaded_mb: float, path: str, columns: str) -> dict[str, Any]:
    """Read a file; return CPU time [s], peak memory [MB], number of messages, and the error or warning.

    Libraries loaded by the parent are not resident in a child before it uses them: the parent counts them.
    """
    before_mb = reset_peak()
    begun = resource.getrusage(resource.RUSAGE_SELF)
    sentence, news = "", 0
    try:
        recording = Recording(path, options=RecordingOptions(columns=columns))
        for _, messages in recording.steps():
            news += len(messages)
        sentence = "; ".join(recording.skipped)
    except (ValueError, OSError) as error:
        sentence = str(error)
    ended = resource.getrusage(resource.RUSAGE_SELF)
    cpu = ended.ru_utime + ended.ru_stime - begun.ru_utime - begun.ru_stime
    return {"cpu_s": cpu, "mb": loaded_mb + peak_mb() - before_mb, "news": news, "sentence": sentence}


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
    """Answer requests until there are no more.

    A child compiles first, so that the memory of a compiler counts for no file.
    """
    child = os.fork()
    if not child:
        try:
            warm_up()
        finally:
            os._exit(0)
    os.waitpid(child, 0)
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
