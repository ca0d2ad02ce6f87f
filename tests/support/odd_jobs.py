"""What a diagnosis may come to in its process, by the UAV id of its job; a process can import this module."""

import os
import signal

from twin_worker.mismatch.job import DiagnosisJob, DiagnosisResult

FINE, RAISES, ENDS, KILLED, HANGS, SPINS = range(6)


def odd(job: DiagnosisJob) -> DiagnosisResult:
    """Answer, or not, as the UAV id says."""
    if job.uav == RAISES:
        return job.rows["nothing of the kind"]  # type: ignore[return-value]
    if job.uav == ENDS:
        raise SystemExit(3)
    if job.uav == KILLED:
        os.kill(os.getpid(), signal.SIGKILL)
    while job.uav == HANGS:
        signal.pause()
    while job.uav == SPINS:
        pass
    return DiagnosisResult(job.uav, 0.0, 1.0)


def deaf(job: DiagnosisJob) -> DiagnosisResult:
    """Take what can only be read slowly."""
    return DiagnosisResult(job.uav, 0.0, float(sum(len(t) for t, _ in job.rows.values())))
