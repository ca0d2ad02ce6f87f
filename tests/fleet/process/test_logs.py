"""What a process says of itself: sentences for people, JSON for machines, numbers for Prometheus."""

import json
import logging
import subprocess
import sys
import threading
import time
import urllib.request
from datetime import datetime

import pytest
from conftest import ROOT, unused_port
from prometheus_client.parser import text_string_to_metric_families

from fleet.contract import FleetRow, FleetState, TwinState
from fleet.metrics import serve
from fleet.process.children import Children
from fleet.process.logs import (
    LogFormatter,
    add_time,
    report_failure,
    report_progress,
    report_status,
    strip_time,
)
from tests.bench.security.bombs import ESCAPES
from tests.support.memory_bus import MemoryBus
from twin_worker.service.work_rates import counters

PATIENCE_S = 10.0


def record(message: str, *, defect: bool = False) -> logging.LogRecord:
    info = None
    if defect:
        try:
            raise ZeroDivisionError("by a stranger")
        except ZeroDivisionError:
            info = sys.exc_info()
    return logging.LogRecord("gateway.publication", logging.WARNING, __file__, 1, "%s", (message,), info)


def test_people_read_a_sentence_that_steers_no_terminal() -> None:
    assert (
        strip_time(LogFormatter("gateway", as_json=False).format(record("the router is away")))
        == "gateway: the router is away"
    )
    said = strip_time(LogFormatter("gateway", as_json=False).format(record(f"uav-7 says {ESCAPES}")))
    assert said.isprintable() and said.startswith("gateway: uav-7 says ?]0;owned??[2J")
    assert "ZeroDivisionError: by a stranger" in LogFormatter("gateway", as_json=False).format(record("x", defect=True))


def test_every_line_of_a_log_begins_with_its_time(capsys) -> None:
    assert add_time("gateway: there", 0.0625) == "1970-01-01T00:00:00.062Z gateway: there"
    later = record("the router is away")
    later.created = 86_400.0
    assert (
        LogFormatter("gateway", as_json=False).format(later) == "1970-01-02T00:00:00.000Z gateway: the router is away"
    )
    begun = time.time() - 0.001
    for one in (report_status, report_progress, report_failure):
        one("gateway", "a\x1b sentence")
    said = "".join(capsys.readouterr()).splitlines()
    assert [strip_time(line) for line in said] == ["gateway: a? sentence"] * 3
    assert all(begun <= datetime.fromisoformat(line.split()[0]).timestamp() <= time.time() for line in said)
    report_failure("fleet status", "nobody answers", logged=False)  # an answer is no line of a log
    assert capsys.readouterr().err == "fleet status: nobody answers\n"


@pytest.mark.parametrize("module", ["gateway", "twin_worker", "viewer"])
def test_a_refusal_in_a_log_has_its_time(module: str) -> None:
    command = [sys.executable, "-m", module, "--router", f"tcp/127.0.0.1:{unused_port()}"]
    command += {"gateway": ["--link=nonsense"], "viewer": ["--port=99999"]}.get(module, [])
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    (line,) = done.stderr.splitlines()
    assert strip_time(line) != line and strip_time(line).startswith(f"{module}: ")


def test_what_a_child_says_again_has_one_time() -> None:
    with Children() as children:
        children.start("one", "gateway", "--link=nonsense")
        ended = threading.Event()
        while not children.failures():
            ended.wait(0.02)
        ((code, sentence),) = children.failures()
    assert code == 2 and sentence.startswith("gateway: --link: found 'nonsense'")


def test_machines_read_one_line_of_json() -> None:
    line = LogFormatter("gateway", as_json=True).format(record(f"uav-7 says {ESCAPES}", defect=True))
    assert line.isprintable()
    told = json.loads(line)
    assert told["message"] == f"uav-7 says {ESCAPES}" and "by a stranger" in told["defect"]
    assert (told["level"], told["process"], told["from"]) == (
        "warning",
        "gateway",
        "gateway.publication",
    )
    assert told["t"].endswith("+00:00")


@pytest.mark.parametrize("module", ["gateway", "twin_worker", "viewer"])
def test_with_log_json_even_a_refusal_is_a_line_of_json(module: str) -> None:
    command = [sys.executable, "-m", module, "--log-json", "--router", f"tcp/127.0.0.1:{unused_port()}"]
    command += {"gateway": ["--link=nonsense"], "viewer": ["--port=99999"]}.get(module, [])
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    told = json.loads(line)
    assert told["level"] == "error" and told["process"] == module
    expected = {"gateway": "found 'nonsense'", "viewer": "--port: found 99999", "twin_worker": "no response; start"}
    assert expected[module] in told["message"]


ROWS = (
    FleetRow(uav=7, state=TwinState.PREDICTING, verdict="", fit={"V": 91.0}, horizon_s=30.0, alerts=("x",), epoch=9),
    FleetRow(uav=8, state=TwinState.WAITING, verdict="", sample_age_s=0.5, mismatch="named icing"),
)


def test_a_worker_tells_prometheus_what_it_holds_and_how_it_fares(free_port: int) -> None:
    bus = MemoryBus()
    bus.bad = 4
    where = f"127.0.0.1:{free_port}"
    state = FleetState(t=1.0, rows=ROWS, dropped_messages=3, tasks={"identify": 12})
    with serve(where, counters(lambda: state, bus)) as at, urllib.request.urlopen(at, timeout=PATIENCE_S) as reply:
        families = list(text_string_to_metric_families(reply.read().decode()))
    found = {(s.name.removesuffix("_total"), *sorted(s.labels.values())): s.value for f in families for s in f.samples}
    assert found["parauav_worker_uavs",] == 2 and found["parauav_worker_router",] == 1
    assert found["parauav_worker_dropped_messages",] == 3 and found["parauav_worker_undecodable",] == 4
    assert found["parauav_worker_state", "predicting"] == 1 == found["parauav_worker_state", "waiting"]
    assert found["parauav_worker_state", "link_lost"] == 0
    assert found["parauav_worker_tasks", "identify"] == 12
    assert found["parauav_twin_horizon_seconds", "7"] == 30.0 and found["parauav_twin_epoch", "7"] == 9
    assert found["parauav_twin_fit_ratio", "7", "V"] == 0.91 and found["parauav_twin_sample_age_seconds", "8"] == 0.5
    assert found["parauav_twin_alerts", "7"] == 1 and found["parauav_twin_mismatch", "8"] == 1
    assert found["process_resident_memory_bytes",] > 1e6 and found["process_cpu_seconds",] > 0
    assert all(family.documentation for family in families)
