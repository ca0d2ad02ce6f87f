"""THE TABLE of DataFlash, row by row: units of every generation, from binary and from text."""

from typing import Any

import numpy as np
import pytest

from fleet.contract import COLUMNS, ROW_WIDTHS
from fleet.telemetry.tables.dataflash import COLUMNS_OF, PARTS, TABLE, field_of
from tests.support.dataflash_writer import Writer, read

DEG = np.pi / 180

POSITION = (-353632610.0, 1491652300.0, 584120.0)
CASES: tuple[tuple[str, tuple[Any, ...], str, str, tuple[float, ...]], ...] = (
    # name + letters + columns, what is logged, part, row of the table read from it
    ("ATT QccccCC TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw", (0.0, 10.0, 0.0, -5.0, 0.0, 270.0), "attitude",
     "ATT", (10 * DEG, -5 * DEG, -90 * DEG)),
    ("IMU Iffffff TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", (0.5, 0.25, -0.5, 1.0, 2.0, -9.5), "imu", "IMU",
     (1.0, 2.0, -9.5, 0.5, 0.25, -0.5)),
    ("IMU QBffffff TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", (0, 0.5, 0.25, -0.5, 1.0, 2.0, -9.5), "imu", "IMU",
     (1.0, 2.0, -9.5, 0.5, 0.25, -0.5)),
    ("POS QLLf TimeUS,Lat,Lng,Alt", (-35.363261, 149.16523, 584.125), "position", "POS", (*POSITION[:2], 584125.0)),
    ("GPS BIHBcLLeeEefI Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T",
     (3, 1000, 1871, 9, 1.5, -35.363261, 149.16523, 3.0, 584.12, 2.0, 90.0, -0.5), "position", "GPS", POSITION),
    ("GPS QBBIHBcLLefff TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ",
     (0, 3, 1000, 2393, 9, 1.5, -35.363261, 149.16523, 584.12, 2.0, 90.0, -0.5), "velocity", "GPS", (0.0, 2.0, -0.5)),
    ("AHR2 IccCfLL TimeMS,Roll,Pitch,Yaw,Alt,Lat,Lng", (1.0, 2.0, 3.0, 584.12, -35.363261, 149.16523), "position",
     "AHR2", POSITION),
    *(
        (f"{name} QBfff TimeUS,C,VN,VE,VD", (0, 3.0, -4.0, 0.5), "velocity", name, (3.0, -4.0, 0.5))
        for name in ("XKF1", "NKF1")
    ),
    *(
        (f"{name} Qfff TimeUS,VN,VE,VD", (3.0, -4.0, 0.5), "velocity", name, (3.0, -4.0, 0.5))
        for name in ("XKF1", "NKF1", "EKF1")
    ),
    ("XKF2 QBcc TimeUS,C,VWN,VWE", (0, 3.5, -2.0), "wind", "XKF2", (3.5, -2.0)),
    ("NKF2 Qcc TimeUS,VWN,VWE", (3.5, -2.0), "wind", "NKF2", (3.5, -2.0)),
    ("EKF2 Icc TimeMS,VWN,VWE", (3.5, -2.0), "wind", "EKF2", (3.5, -2.0)),
    ("RCOU Qhhhh TimeUS,Ch1,Ch2,Ch3,Ch4", (1000, 1100, 1200, 1300), "servo", "RCOU",
     (1000, 1100, 1200, 1300, 0, 0, 0, 0)),
    ("RCOU QHHHHHHHHH TimeUS,C1,C2,C3,C4,C5,C6,C7,C8,C9", tuple(range(1001, 1010)), "servo", "RCOU",
     tuple(range(1001, 1009))),
    (f"RCOU Q{'H' * 14} TimeUS,{','.join(f'C{n}' for n in range(1, 15))}", tuple(range(1001, 1015)), "servo", "RCOU",
     (*range(1001, 1015), 0, 0)[:14]),
    ("MOT Ihhhhhh TimeMS,Mot1,Mot2,Mot3,Mot4,Mot5,Mot6", (1, 2, 3, 4, 5, 6), "servo", "MOT", (1, 2, 3, 4, 5, 6, 0, 0)),
    ("MISE QHHHffffLLfB TimeUS,CTot,CNum,CId,Prm1,Prm2,Prm3,Prm4,Lat,Lng,Alt,Frame",
     (9, 4, 16, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 5.0, 3), "leg", "MISE", (4,)),
    ("CMD IHHHfffffff TimeMS,CTot,CNum,CId,Prm1,Prm2,Prm3,Prm4,Lat,Lng,Alt",
     (9, 4, 16, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 5.0), "leg", "CMD", (4,)),
    ("NTUN QfcccfffLLeee TimeUS,Dist,TBrg,NavBrg,AltE,XT,XTi,AsE,TLat,TLng,TAW,TAT,TAsp",
     (1.0, 0.0, 0.0, 2.5, 3.5, 0.0, -1.5, -35.363261, 149.16523, 584.12, 9.0, 22.0), "target", "NTUN", POSITION),
    ("NTUN QfcccfffLLii TimeUS,Dist,TBrg,NavBrg,AltErr,XT,XTi,AspdE,TLat,TLng,TAlt,TAspd",
     (1.0, 0.0, 0.0, 2.5, 3.5, 0.0, -1.5, -35.363261, 149.16523, 58412, 2200), "target", "NTUN", POSITION),
    ("NTUN QfcccfffLLee TimeUS,Dist,TBrg,NavBrg,AltE,XT,XTi,AsE,TLat,TLng,TAlt,TAsp",
     (1.0, 0.0, 0.0, 2.5, 3.5, 0.0, -1.5, -35.363261, 149.16523, 584.12, 22.0), "target", "NTUN", POSITION),
    ("BARO QBffc TimeUS,I,Alt,Press,Temp", (0, 100.0, 94501.5, 25.0), "pressure", "BARO", (94501.5,)),
    ("BARO Iffc TimeMS,Alt,Press,Temp", (100.0, 94501.5, 25.0), "pressure", "BARO", (94501.5,)),
    ("GPS BIHBcLLeeEefI Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T",
     (3, 1000, 1871, 9, 1.5, -35.363261, 149.16523, 3.0, 584.12, 2.0, 90.0, -0.5), "gnss", "GPS", POSITION[2:]),
)  # fmt: skip


def stamps(columns: str, i: int) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """What to put before and behind the values of message `i`, 0.1 s apart."""
    if columns.startswith("TimeUS"):
        return (1_000_000 + 100_000 * i,), ()
    return ((1000 + 100 * i,), ()) if columns.startswith("TimeMS") else ((), (1000 + 100 * i,))


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("case", CASES, ids=lambda c: c[0].split(" ", 2)[0] + "-" + c[2])
def test_a_row_has_its_unit(case: tuple[Any, ...], text: bool) -> None:
    (name, letters, columns), logged, part, message, expected = case[0].split(" ", 2), *case[1:]
    writer = Writer(text).fmt(name, letters, columns)
    if part == "attitude":
        writer.fmt("IMU", "Qffffff", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    for i in range(5):
        before, behind = stamps(columns, i)
        writer.say(name, *before, *logged, *behind)
        if part == "attitude":
            writer.say("IMU", 1_000_000 + 100_000 * i, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8)
    log = writer.log()
    rows, _, _ = read(log)
    t, found = rows[part]
    assert log.sources[part].message == message
    np.testing.assert_allclose(t, 1.0 + 0.1 * np.arange(5), atol=1e-9)
    np.testing.assert_allclose(found[0, : len(expected)], expected, rtol=1e-6, atol=1e-6)
    if part == "attitude":
        np.testing.assert_allclose(found[0, 3:], (0.1, 0.2, 0.3), rtol=1e-6)


AIR = (
    ("CTUN QccccffffBfi TimeUS,NavRoll,Roll,NavPitch,Pitch,ThO,RdO,ThD,As,AsT,E2T,GU",
     (0.0, 0.0, 0.0, 0.0, 55.0, 0.0, 0.0, 21.5, 1, 1.0, 0), None, ()),
    ("CTUN Qcccchhhf TimeUS,NavRoll,Roll,NavPitch,Pitch,ThrOut,RdrOut,ThrDem,Aspd",
     (0.0, 0.0, 0.0, 0.0, 55, 0, 0, 21.5), None, ()),
    ("CTUN Qcccchhf TimeUS,NavRoll,Roll,NavPitch,Pitch,ThrOut,RdrOut,AccY", (0.0, 0.0, 0.0, 0.0, 55, 0, 0.0),
     "NTUN QCfccccfI TimeUS,Yaw,WpDist,TargBrg,NavBrg,AltErr,Arspd,Alt,GSpdCM", (1.0, 1.0, 0.0, 0.0, 0.0, 21.5, 9.0, 9)),  # noqa: E501
    ("CTUN Qffff TimeUS,ThI,ABst,ThO,ThH", (0.5, 0.0, 0.55, 0.3),
     "ARSP QBfBf TimeUS,I,Airspeed,U,Temp", (0, 21.5, 1, 20.0)),
    ("CTUN Qhhffe TimeUS,ThrIn,AngBst,ThrOut,DAlt,Alt", (0, 0, 0.55, 1.0, 1.0),
     "ARSP Qff TimeUS,Airspeed,DiffPress", (21.5, 1.0)),
    ("CTUN Qhhhfe TimeUS,ThrIn,AngBst,ThrOut,DAlt,Alt", (0, 0, 550, 1.0, 1.0),
     "ARSP Qff TimeUS,Airspeed,DiffPress", (21.5, 1.0)),
)  # fmt: skip


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize(("throttle", "logged", "speed", "said"), AIR)
def test_throttle_and_airspeed_have_one_unit_through_the_years(
    throttle: str, logged: tuple[Any, ...], speed: str | None, said: tuple[Any, ...], text: bool
) -> None:
    writer = Writer(text).fmt("BARO", "Qff", "TimeUS,Alt,CRt").fmt(*throttle.split(" ", 2))
    if speed:
        writer.fmt(*speed.split(" ", 2))
    for i in range(5):
        t = 1_000_000 + 100_000 * i
        writer.say("BARO", t, 100.0, 1.5).say("CTUN", t, *logged)
        if speed:
            writer.say(speed.split()[0], t, *said)
    rows, _, _ = read(writer.log())
    np.testing.assert_allclose(rows["air"][1], [[21.5, 0.55, 1.5]] * 5, rtol=1e-6)


@pytest.mark.parametrize("names", ["AltE XT AsE", "AltErr XT AspdE", "AltErr XT ArspdErr"])
def test_a_command_is_joined_of_attitude_and_navigation(names: str) -> None:
    altitude, xtrack, speed = names.split()
    writer = Writer().fmt("ATT", "Qcccc", "TimeUS,DesRoll,Roll,DesPitch,Pitch")
    writer.fmt("NTUN", "Qcff", f"TimeUS,{altitude},{xtrack},{speed}")
    for i in range(20):
        writer.say("ATT", 1_000_000 + 50_000 * i, 30.0, 0.0, -3.0, 0.0)
        if not i % 2:
            writer.say("NTUN", 1_000_000 + 50_000 * i, 0.5, float(i), -1.5)
    t, found = read(writer.log())[0]["command"]
    np.testing.assert_allclose(found[:, :2], [[30 * DEG, -3 * DEG]] * len(t))
    np.testing.assert_allclose(found[:19, 2], np.arange(19.0), atol=1e-9)  # interpolated half-way
    np.testing.assert_allclose(found[:, 3:], [[0.5, -1.5]] * len(t))


def test_every_row_of_the_table_has_a_place_to_go() -> None:
    for row in TABLE:
        assert field_of(row.field) in COLUMNS
        assert row.field in COLUMNS_OF or field_of(row.field) not in PARTS
    for field, parts in PARTS.items():
        assert sum(n for _, n in parts) == ROW_WIDTHS[field][-1]


@pytest.mark.parametrize("has_rest", [False, True])
def test_outputs_15_and_16_come_from_their_own_message(has_rest: bool) -> None:
    writer = Writer(False).fmt("RCOU", "Q" + "H" * 14, "TimeUS," + ",".join(f"C{n}" for n in range(1, 15)))
    writer.fmt("RCO2", "QHHHH", "TimeUS,C15,C16,C17,C18")
    for i in range(20):
        writer.say("RCOU", 1_000_000 + 50_000 * i, *range(1001, 1015))
        if has_rest:
            writer.say("RCO2", 1_000_000 + 50_000 * i, 1015, 1016, 1017, 1018)
    t, servo = read(writer.log())[0]["servo"]
    assert len(t) == 20
    np.testing.assert_array_equal(servo[3], [*range(1001, 1015), *([1015, 1016] if has_rest else [])])
