"""One flight, heard by radio and read from the aircraft's own log: the same rows, in the same units and signs."""

import lzma
from pathlib import Path

import numpy as np

from fleet.contract import COLUMNS, Sample
from fleet.telemetry.onboard_logs.dataflash.reader import DataflashLog
from fleet.telemetry.recording.recordings import replay_messages
from tests.support.dataflash_writer import read

NAME = "s01_nominal_calm"
STEPS = ("leg", "servo")  # not to be interpolated
RADIO_ONLY = {"height", "bearing", "battery"}  # above home; to the path; of the propulsion


def test_the_log_says_what_the_radio_said(recordings: Path) -> None:
    radio: dict[str, list] = {}
    for news in replay_messages(recordings / "sitl" / f"{NAME}.tlog.xz"):
        if isinstance(news, Sample):
            for field in COLUMNS:
                if (rows := getattr(news, field)) is not None:
                    radio.setdefault(field, []).append((rows.t.numpy(), rows.x.numpy().astype(float)))
    log = DataflashLog(lambda: lzma.open(recordings / "sitl" / f"{NAME}.BIN.xz"), NAME)  # noqa: SIM115
    own, _, _ = read(log)
    assert log.epoch_s is not None and set(own) == set(radio) - RADIO_ONLY
    for field in set(COLUMNS) - set(STEPS) - RADIO_ONLY:
        t, x = (np.concatenate([part[i] for part in radio[field]]) for i in (0, 1))
        t_own, x_own = own[field][0] + log.epoch_s, own[field][1]
        inside = (t > t_own[0] + 20) & (t < t_own[-1] - 30)
        for column, (name, _) in enumerate(COLUMNS[field]):
            mine, theirs = np.interp(t[inside], t_own, x_own[:, column]), x[inside, column]
            apart = np.median(np.abs(mine - theirs))
            assert apart < 0.1 * np.std(theirs) + 1e-6, f"{field}.{name} is {apart} apart"
