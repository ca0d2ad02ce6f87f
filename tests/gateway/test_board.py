"""The counters shown: on a terminal, in plain lines, to Prometheus; and whether they add up."""

import io
import socket
import threading
import urllib.request

import msgspec
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from rich.console import Console
from test_gateway import PATIENCE_S, Ear

from fleet.contract import GatewayCounters, Status
from fleet.metrics import serve, with_unit
from gateway import status as status_table
from gateway.link_spec import read_spec
from gateway.links.receive import Udp
from gateway.pipeline import Pipeline
from gateway.record.recorder import LinkRecorder
from gateway.record.tape import DiskBudget
from gateway.status import counters, format_line, overruns, render, status_display
from tests.support.examples import EXAMPLES
from tests.support.memory_bus import MemoryBus
from tests.support.talker import T0, Talker

ACCOUNT, STATUS = EXAMPLES[GatewayCounters], EXAMPLES[Status]


def drawing(account, statuses):
    console = Console(file=io.StringIO(), width=180)
    console.print(render(account, statuses))
    return console.file.getvalue()


def test_the_table_names_links_and_aircraft_and_whatever_is_wrong():
    text = drawing(ACCOUNT, [STATUS])
    assert "udpin:0.0.0.0:14550" in text and "900 B (-60 B)" in text and "! fine" in text
    assert "20 (300)" in text and "link lost 3 s ago" in text and "no router" in text and "6 unsent" in text


def test_of_many_aircraft_those_in_trouble_are_shown():
    statuses = [Status(uav=k, t=T0, sentence="engine is on fire" if k == 99 else "") for k in range(100)]
    text = drawing(ACCOUNT, statuses)
    assert "engine is on fire" in text and "60 more without warnings" in text


def test_plain_lines_come_at_news_and_now_and_then(monkeypatch):
    monkeypatch.setattr(status_table, "REFRESH_S", 0.001)
    monkeypatch.setattr(status_table, "PLAIN_S", 0.05)
    said, enough = [], threading.Event()

    def say(line):
        said.append(line)
        if format_line(ACCOUNT, [STATUS]) in said and said.count("fine") == 1:
            enough.set()

    with status_display(lambda: (ACCOUNT, [STATUS]), say):
        assert enough.wait(PATIENCE_S)


def test_a_plain_line_comes_at_once_when_aircraft_come_or_go(monkeypatch):
    monkeypatch.setattr(status_table, "REFRESH_S", 0.001)
    shown = [(), (7,), (7, 8), (7,)]  # ids received, one after the other
    lines, enough = [], threading.Event()

    def say(line):
        lines.append(line)
        shown.pop(0) if len(shown) > 1 else enough.set()

    def account():
        return msgspec.structs.replace(ACCOUNT, uavs=shown[0], per_link=()), [STATUS]

    shown.pop(0)  # none so far: no line
    with status_display(account, say):
        assert enough.wait(PATIENCE_S)
    assert [line.split()[0] for line in lines] == ["1", "2", "1"]


def test_prometheus_reads_every_number_of_the_account(free_port):
    with serve(f"127.0.0.1:{free_port}", counters(lambda: (ACCOUNT, [STATUS]))) as address:
        with urllib.request.urlopen(address, timeout=PATIENCE_S) as reply:
            families = list(text_string_to_metric_families(reply.read().decode()))
        with pytest.raises(OSError, match="is not free"), serve(f"127.0.0.1:{free_port}", list):
            pass
    found = {(s.name.removesuffix("_total"), *sorted(s.labels.values())): s.value for f in families for s in f.samples}
    link = ACCOUNT.per_link[0]
    for name, value in msgspec.structs.asdict(link).items():
        if isinstance(value, int | float):
            named = {"overrun": "overrun_datagrams", "dropped": "dropped_datagrams", "sent": "sent_datagrams"}
            named |= {"bytes_s": "bytes_per_second"}
            metric = named.get(name) or with_unit(name)
            assert found[f"parauav_link_{metric}", link.link] == value
    assert found["parauav_gateway_unsent",] == 6 and found["parauav_gateway_router",] == 0
    assert found["parauav_gateway_refused", "stale"] == 1
    assert found["parauav_uav_missed", "7"] == 3 and found["parauav_uav_rate_hertz", "7", "ATTITUDE"] == 25.0
    assert {f.type for f in families if f.name == "parauav_link_bytes_in"} == {"counter"}
    assert all(family.documentation for family in families)


@pytest.mark.parametrize("where", ["9100", "127.0.0.1:", "127.0.0.1:x", "127.0.0.1:99999"])
def test_what_is_no_address_stops_at_start(where):
    with pytest.raises(ValueError, match=r"^--metrics: found .*; correct it$"), serve(where, list):
        pass


def test_what_the_system_dropped_is_read(tmp_path):
    head = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode ref drops"
    rows = [f"{k}: 0100007F:{port:04X} 00000000:0000 07 0:0 00:0 0 0 0 1 2 0 {drops}" for k, port, drops in
            ((1, 14550, 40), (2, 14551, 3), (3, 14550, 2))]  # fmt: skip
    (tmp_path / "udp").write_text("\n".join([head, *rows]) + "\n")
    found = overruns([tmp_path / "udp", tmp_path / "none"])
    assert found[14550] == 42 and 9 not in found


def test_everything_sent_is_received_overrun_or_dropped_and_what_was_heard_is_recorded_or_counted(tmp_path, free_port):
    """A flood far beyond what the system's buffer holds, while the reader is held up; damage and noise among it."""
    rng, talker = np.random.default_rng(11), Talker()
    said = [talker.heartbeat() if k % 50 == 0 else talker.attitude(0.02 * k) for k in range(400)]
    said += [rng.bytes(500) for _ in range(50)]
    link = Udp(read_spec(f"udpin:127.0.0.1:{free_port}"))
    link._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # the least there is
    bus, stop, sent = MemoryBus(), threading.Event(), 0

    def found(ear):
        return [
            one.datagrams + one.overrun + one.dropped for one in (m.per_link[0] for m in ear.of(GatewayCounters)[-1:])
        ]

    with LinkRecorder(DiskBudget(tmp_path, 10**9), [link.spec.text]) as recorder:
        ear, pump = Ear(bus), Pipeline([link], bus, recorder=recorder)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as air:
            for data in said:  # nobody reads yet
                sent += air.sendto(data, ("127.0.0.1", free_port)) > 0
            thread = threading.Thread(target=pump.run, args=(stop,))
            thread.start()
            ear.wait(lambda e: found(e) == [sent])
            for data in said[:20]:
                sent += air.sendto(data, ("127.0.0.1", free_port)) > 0
            ear.wait(lambda e: found(e) == [sent])
        stop.set()
        thread.join(PATIENCE_S)
    (final,) = pump.publisher.newest_account.per_link
    (taped,) = recorder.counters()
    assert final.overrun > 100 and final.datagrams > 2
    assert taped.received == final.bytes_in + final.bytes_out
    assert taped.received == taped.recorded + taped.noise + taped.lost + taped.dropped + taped.waiting
    assert taped.recorded == sum(p.stat().st_size for p in tmp_path.glob("*.tlog")) - 8 * taped.frames
