"""The whole product as real processes on ports of its own: flown, replayed, attacked, stopped, misused."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, exit_code, unused_port
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet import cli
from fleet.bus.session import Bus, connect
from fleet.commands.live.status import fleet_rows
from fleet.contract import (
    FleetState,
    GatewayCounters,
    Mission,
    Model,
    Params,
    Prediction,
    Sample,
    Status,
    TwinState,
    Verdict,
)
from fleet.process import logs
from tests.support.fake_link import beside_compiling
from tests.support.talker import Talker

PATIENCE_S = 300.0  # an upper bound on a cold machine; every wait ends with its condition
ROW = {"uav", "state", "verdict", "fit", "horizon_s", "worker", "sample_age_s", "prediction_age_s"}
NAN = float("nan")


def wait(condition: Callable[[], object], child: subprocess.Popen | None = None) -> None:
    """Wait for a condition; a child that dies, or the end of patience, fails the test."""
    never, until = threading.Event(), time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until, "waited in vain"
        assert child is None or child.poll() is None, "a process died"
        never.wait(0.1)


@contextmanager
def process(*arguments: str, cache: Path | None = None) -> Iterator[subprocess.Popen]:
    """Run one command until the block ends; with `cache`, a folder where nothing is compiled yet."""
    command = [sys.executable, "-m", *arguments]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    if cache is not None:
        env.pop("NUMBA_CACHE_DIR", None)
        env["PARAUAV_CACHE"] = str(cache)
    with subprocess.Popen(
        command, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        try:
            yield child
        finally:
            child.kill()  # else whoever does not hear would be waited for without end


def ended(child: subprocess.Popen) -> tuple[int, str, str]:
    out, errors = child.communicate(timeout=PATIENCE_S)
    return child.returncode, out, errors


def udp_port() -> int:
    return unused_port(socket.SOCK_DGRAM)


def own_ports() -> tuple[list[str], str]:
    router = f"tcp/127.0.0.1:{unused_port()}"
    return ["--no-viewer", "--router", router, "--mavlink", f"127.0.0.1:{udp_port()}"], router


# --- fleet up --------------------------------------------------------------------------------------------------------


def test_a_fleet_of_two_flies_answers_and_leaves_a_summary(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    ports, router = own_ports()
    summary = tmp_path / "summary.json"
    with process("fleet.cli", "up", "--uavs", "2", "--for", "12", "--summary", str(summary), *ports) as up:
        wait(lambda: _rows(router) >= 2, up)
        assert cli.main(["status", "--json", "--router", router]) == 0
        said = capfd.readouterr()
        assert said.err == ""
        asked = json.loads(said.out)
        code, _, errors = ended(up)
    assert code == 0, errors
    rows = json.loads(summary.read_text())
    assert [row["uav"] for row in asked] == [row["uav"] for row in rows] == [0, 1]
    assert all(set(row) >= ROW for row in asked)
    assert all(set(row) >= ROW | {"t10_s", "t10_censored"} for row in rows)
    assert "compiling" in errors and "since the first sample" in errors


def _rows(router: str) -> int:
    try:
        with connect(router) as bus:
            return len(fleet_rows(bus))
    except ConnectionError:
        return 0


def test_ctrl_c_while_compiling_ends_every_child(tmp_path: Path) -> None:
    ports, _ = own_ports()
    with process("fleet.cli", "up", "--uavs", "1", *ports, cache=tmp_path) as up:
        wait(lambda: "compiling" in up.stderr.readline(), up)
        children = _children(up.pid)
        assert len(children) == 3
        up.send_signal(signal.SIGINT)
        code, _, errors = ended(up)
    assert code == 0, errors
    assert "Traceback" not in errors
    assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]


def test_a_fleet_whose_parent_is_killed_ends_all_the_same() -> None:
    ports, _ = own_ports()
    with process("fleet.cli", "up", "--uavs", "1", *ports) as up:
        wait(lambda: "UAVs" in up.stderr.readline(), up)
        children = _children(up.pid)
        assert len(children) == 3
        up.kill()
        wait(lambda: not any(_alive(pid) for pid in children))


def test_an_orphan_that_hangs_ends_too() -> None:
    soon = "from fleet import cli; assert cli.ORPHAN_GRACE_S > 0.1; cli.ORPHAN_GRACE_S = 0.1"
    hangs = f"{soon}; cli.stop_on_signal(); import threading; threading.Event().wait()"
    done = subprocess.run(
        [sys.executable, "-c", hangs], cwd=ROOT, env=os.environ | {cli.PARENT: "1"}, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 1


def test_ctrl_c_is_heard_whatever_the_main_thread_is_doing() -> None:
    """Once it came while the main thread held the event's own lock, as it does 50 times a second: nobody ended."""
    told = "import signal; from fleet import cli; stop = cli.stop_on_signal()\nwith stop._cond: signal.raise_signal(2)"
    waits = f"{told}\nraise SystemExit(not stop.wait())"
    done = subprocess.run([sys.executable, "-c", waits], cwd=ROOT, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0


def _alive(pid: int) -> bool:
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def _children(pid: int) -> list[int]:
    listed = f"/proc/{pid}/task/{pid}/children"
    return [int(child) for child in Path(listed).read_text().split()]


REFUSED = {  # before anything is begun
    ("--uavs", "0"): "--uavs: found 0, expected 1 to 250",
    ("--for", "-1"): "--for: found -1.0 s, expected 0",
    ("--replay", "none.tlog"): "--replay: found no file 'none.tlog', expected a recording",
    ("--summary", "none/s.json"): "--summary: found no folder 'none', expected one",
    ("--mavlink", "14550"): "--mavlink: found '14550', expected HOST:PORT",
}
REFUSED_LATER = {
    ("--router", "nowhere"): "--router: found 'nowhere', expected",
    ("--router", "tcp/192.0.2.1:7447"): "no response, and no router can be opened here",
    ("--link", "ftp:a:1"): "--link: found 'ftp:a:1', expected udpin, udpout",
}


@pytest.mark.parametrize("options", [*REFUSED, *REFUSED_LATER], ids=" ".join)
def test_what_makes_no_sense_is_refused_in_one_sentence(
    options: tuple[str, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    ports, _ = own_ports()
    if options in REFUSED:
        code, errors = exit_code(lambda: cli.main(["up", *ports, *options])), capfd.readouterr().err
    else:
        with process("fleet.cli", "up", *ports, *options) as up:
            code, _, errors = ended(up)
    last = logs.strip_time(errors.splitlines()[-1])
    assert code == 2
    assert last.startswith("fleet up: ") and (REFUSED | REFUSED_LATER)[options] in last and ";" in last
    assert "Traceback" not in errors


def test_a_busy_port_is_refused_in_one_sentence() -> None:
    ports, _ = own_ports()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("127.0.0.1", 0))
        with process("fleet.cli", "up", *ports, "--mavlink", f"127.0.0.1:{held.getsockname()[1]}") as up:
            code, _, errors = ended(up)
    assert code == 2
    assert errors.count("\n") == 1 and "stop the other fleet, or name another port" in errors


# --- a recording -----------------------------------------------------------------------------------------------------


@pytest.mark.recordings
def test_a_flight_of_another_autopilot_is_predicted_on_its_own_mission(router: str, recordings: Path) -> None:
    flight = recordings / "sitl" / "s02_nominal_light_wind.tlog.xz"
    uav = 1000  # apart from every other test
    predicted: list[Prediction] = []
    models: list[Model] = []

    def by_model(p: Prediction) -> bool:
        return p.state is TwinState.PREDICTING and p.method in ("dynamics", "hybrid", "both")

    def verified() -> list[Verdict]:
        return [m.verdict for m in models if m.verdict.outcome.is_accepted]

    with connect(router) as bus, process("twin_worker", "--uavs", f"{uav}-{uav + 99}", "--router", router) as worker:
        wait(lambda: "serves UAV ids" in worker.stdout.readline(), worker)
        bus.subscribe(Prediction, lambda message, _: predicted.append(message))
        bus.subscribe(Model, lambda message, _: models.append(message))
        link = f"replay:{flight}?speed=8"  # slower than any machine's worker, or what is identified depends on its load
        with process("gateway", "--link", link, f"--offset={uav}", "--router", router) as gateway:
            # both, for a point mass is fitted and predicts (method "hybrid") before the first model is verified
            wait(lambda: any(by_model(p) for p in predicted) and verified(), gateway)
            ((mission, _),), ((params, _),) = bus.get(Mission), bus.get(Params)
    good = next(filter(by_model, predicted))
    assert mission.complete and len(mission.items) == 17
    assert params.complete and "NAVL1_PERIOD" in params.values
    assert all(v.horizon_s >= 4.0 for v in verified()), [m.verdict.sentence for m in models]
    assert good.horizon_s > 0 and 0 <= good.seq < 17
    assert np.isfinite(good.path.numpy()).all() and np.isfinite(good.prediction_region_half_axes.numpy()).all()


# --- hostile input ---------------------------------------------------------------------------------------------------


class Listener:
    """Count samples per UAV, keep the newest of everything else."""

    def __init__(self, bus: Bus) -> None:
        self.samples: dict[int, int] = {}
        self.said: dict[type, dict[int, object]] = {Status: {}, Mission: {}, Params: {}}
        self.sentences: set[str] = set()
        self.account = GatewayCounters(t=0.0)
        self.worker: FleetState | None = None
        bus.subscribe(Sample, self._sample)
        bus.subscribe(GatewayCounters, lambda message, _: setattr(self, "account", message))
        bus.subscribe(FleetState, lambda message, _: setattr(self, "worker", message))
        for kind in self.said:
            bus.subscribe(kind, lambda message, _: self.sentences.add(message.sentence))

    def _sample(self, message: Sample, _: object) -> None:
        self.samples[message.uav] = self.samples.get(message.uav, 0) + 1

    def told(self, *words: str) -> bool:
        return all(any(word in sentence for sentence in list(self.sentences)) for word in words)


def test_hostile_bytes_and_missions_leave_the_others_flying(router: str) -> None:
    port = udp_port()
    link = ["--link", f"udpin:127.0.0.1:{port}", "--offset=-1"]
    fly = ["--uavs", "0-1", "--to", f"127.0.0.1:{port}"]
    with (
        connect(router) as bus,
        process("gateway", *link, "--router", router) as gateway,
        process("twin_worker", "--uavs", "0-99", "--router", router) as worker,
        process("fleet.cli", "fly", *fly) as aircraft,
    ):
        heard = Listener(bus)
        wait(lambda: min(heard.samples.get(uav, 0) for uav in (0, 1)) > 20, aircraft)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as attacker:
            attacker.connect(("127.0.0.1", port))
            _noise(attacker)
            wait(lambda: heard.account.bad_bytes > 500_000, gateway)
            for frames in hostile():
                attacker.send(frames)
            wait(
                lambda: heard.told("no items", "invalid coordinate", "never reaches", "no length", "not a number"),
                gateway,
            )
            _wild_clock(attacker, heard, gateway)
        before = dict(heard.samples)
        wait(lambda: all(heard.samples[uav] > before[uav] + 20 for uav in (0, 1)), gateway)
        wait(lambda: heard.worker and {0, 1} <= {row.uav for row in heard.worker.rows}, worker)
        assert [child.poll() for child in (gateway, worker, aircraft)] == [None] * 3
        assert heard.account.datagrams > 1000 and set(heard.account.uavs) >= {0, 1}
        statuses = {status.uav: status for status, _ in bus.get(Status)}
        assert statuses[0].clock_jumps == statuses[1].clock_jumps == 0
        for child in (gateway, worker, aircraft):
            child.send_signal(signal.SIGINT)
        found = [ended(child) for child in (gateway, worker, aircraft)]
    assert [(code, beside_compiling(errors)) for code, _, errors in found] == [(0, "")] * 3


def _noise(attacker: socket.socket) -> None:
    """Send a megabyte of random bytes, no faster than a socket buffer empties."""
    junk, pause = np.random.default_rng(5).bytes(1_000_000), threading.Event()
    for start in range(0, len(junk), 1000):
        attacker.send(junk[start : start + 1000])
        if start % 50_000 == 0:
            pause.wait(0.01)


def hostile() -> Iterator[bytes]:
    """One system per mission that cannot be flown, and one with parameters that are no numbers."""
    empty, lost, jump, still, params = (Talker(system) for system in range(41, 46))
    bad = mav.MAVLink_mission_item_message(255, 190, 1, 3, 16, 0, 1, NAN, 0, 0, 0, NAN, NAN, NAN)
    jumps = [jump.item(1, 177, x=0, y=0, z=0, p1=2), jump.item(2, 177, x=0, y=0, z=0, p1=1)]
    yield empty.heartbeat() + empty.attitude(1.0) + empty.count(0)
    yield lost.heartbeat() + lost.attitude(1.0) + lost.mission(lost.item(0), lost.pack(bad))
    yield jump.heartbeat() + jump.attitude(1.0) + jump.mission(jump.item(0), *jumps)
    yield still.heartbeat() + still.attitude(1.0) + still.mission(*[still.item(seq) for seq in range(4)])
    yield params.heartbeat() + params.param("TRIM_ARSPD_CM", NAN, 0, 1) + params.attitude(1.0)


def _wild_clock(attacker: socket.socket, heard: Listener, gateway: subprocess.Popen) -> None:
    """Let system 46 speak at 50 Hz until its clock, set back by 1,000 s on the way, has been noticed."""
    wild, begun = Talker(46), time.monotonic()
    attacker.send(wild.heartbeat())

    def speak() -> bool:
        passed = time.monotonic() - begun
        attacker.send(wild.heartbeat() + wild.attitude(2000 + passed - (1000 if passed > 3 else 0)))
        return heard.told("clock jumped")

    wait(speak, gateway)
