"""Links as they are asked for: their kinds, and the sieves on them."""

import numpy as np
import pytest

from gateway.link_spec import read_filter, read_forward, read_spec


def test_links_are_read():
    assert read_spec("tcp:10.0.0.1:5760")[1:4] == ("tcp", "10.0.0.1", 5760)
    assert read_spec("serial:/dev/ttyUSB0:115200")[1:4] == ("serial", "/dev/ttyUSB0", 115_200)
    assert read_spec("serial:/dev/serial/by-path/pci-0:1:1.0-port0")[2:4] == (
        "/dev/serial/by-path/pci-0:1:1.0-port0",
        57_600,
    )
    assert read_spec("udpin:[::1]:14550#sign=require&key=k")[2:4] == ("::1", 14550)
    assert read_forward("udpin::14551#no-messages=RAW_IMU").message_filter.rules


@pytest.mark.parametrize("text", ["replay:a.tlog", "udpin:h:1#offset=2"])
def test_a_forward_is_no_recording_and_has_no_offset(text):
    with pytest.raises(ValueError, match=r"--forward: found .*, expected a link to a ground station"):
        read_forward(text)


def test_a_sieve_keeps_by_message_system_and_component():
    at = np.zeros((6, 8), np.int64)
    at[:, 4], at[:, 5], at[:, 6] = (0, 30, 30, 253, 30, 27), (1, 1, 2, 1, 3, 1), (1, 1, 1, 1, 1, 154)
    assert read_filter({}).passes(at).all()
    for settings, kept in (
        ({"messages": "ATTITUDE,0"}, [1, 1, 1, 0, 1, 0]),
        ({"no-messages": "statustext"}, [1, 1, 1, 0, 1, 1]),
        ({"systems": "2-3"}, [0, 0, 1, 0, 1, 0]),
        ({"no-components": "154", "systems": "1"}, [1, 1, 0, 1, 0, 0]),
    ):
        assert read_filter(dict(settings)).passes(at).tolist() == list(map(bool, kept))


@pytest.mark.parametrize("settings", [{"messages": "ATITUDE"}, {"systems": "256"}, {"components": "5-2"}])
def test_what_is_no_sieve_says_so(settings):
    with pytest.raises(ValueError, match=r"found '.*', expected .*numbers up to"):
        read_filter(settings)
