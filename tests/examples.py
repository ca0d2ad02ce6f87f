"""One example of every message, with fixed values; a new class in the contract adds its own here."""

import numpy as np

from fleet.contract import (
    COLUMNS,
    Account,
    Alert,
    AlertKind,
    Array,
    Cause,
    Controller,
    Derivatives,
    Event,
    FleetRow,
    FleetState,
    Found,
    Item,
    Linear,
    Link,
    Mismatch,
    Mission,
    Model,
    Outcome,
    Params,
    Prediction,
    Rows,
    Sample,
    State,
    Status,
    Verdict,
)

UAV, T = 7, 1_700_000_000.25


def _rows(name: str) -> Rows:
    k = len(COLUMNS[name])
    dtype = "<i4" if name in ("position", "gnss") else "<f4"
    return Rows(t=Array.of([T - 0.1, T], "<f8"), x=Array.of(np.arange(2 * k).reshape(2, k) * 0.5, dtype))


def _linear(states: tuple[str, ...], inputs: tuple[str, ...]) -> Linear:
    n, m = len(states), len(inputs)
    return Linear(
        states=states,
        inputs=inputs,
        A=Array.of(np.eye(n) * 0.5, "<f8"),
        B=Array.of(np.ones((n, m)), "<f8"),
        C=Array.of(np.eye(n), "<f8"),
        D=Array.of(np.zeros((n, m)), "<f8"),
        x_trim=Array.of(np.arange(n), "<f8"),
        u_trim=Array.of(np.arange(m), "<f8"),
        dt_s=0.04,
    )


VERDICT = Verdict(
    outcome=Outcome.VERIFIED,
    sentence="fit 93 % over 4 s",
    fit={"u": 91.0, "q": 95.0},
    fit_hold={"u": 50.0, "q": 10.0},
    fit_at={"lon4": 93.0, "lat4": 92.0},
    whiteness={"u": 0.95, "q": 0.1},
    horizon_s=4.0,
    threshold=90.0,
    tries=2,
)
DERIVATIVES = Derivatives(
    names=("X_0", "w_n"),
    value=Array.of([0.5, 3.0], "<f8"),
    covariance=Array.of(np.eye(2)),
    told=Array.of([0.25, 0.75]),
    U0=22.0,
    W0=1.0,
    tau_s=Array.of([0.0625, 0.0625, 0.0625, 0.25]),
    prior="generic small fixed wing",
    window_t0=T - 40.0,
    window_s=20.0,
    sentence="1 of 2 parameters told by the data",
)
ITEM = Item(
    seq=1, command=16, frame=3, param1=5.0, param2=60.0, param3=1.0, param4=0.5, lat_e7=1, lon_e7=2, alt_m=100.0
)
ROW = FleetRow(
    uav=UAV,
    state=State.PREDICTING,
    verdict=VERDICT.sentence,
    fit=VERDICT.fit,
    horizon_s=20.0,
    worker="00000000000000ff",
    sample_age_s=0.1,
    prediction_age_s=0.5,
    t10_s=18.0,
    t10_censored=0.25,
    t10_n=4,
    epoch=1_700_000_000_000,
    alerts=("uav 8 in 12 s",),
)

MESSAGES = (
    Sample(uav=UAV, t=T, **{name: _rows(name) for name in COLUMNS}),
    Status(
        uav=UAV,
        t=T,
        link=Link.LOST,
        mode="AUTO",
        armed=True,
        autopilot="ardupilot",
        vehicle="fixed_wing",
        rates_hz={"ATTITUDE": 25.0},
        received=100,
        missed=3,
        rejected=1,
        clock_offset_s=12.5,
        clock_jumps=1,
        sentence="link lost 3 s ago",
    ),
    Mission(uav=UAV, t=T, items=(ITEM,), seq=1, complete=True, sentence="fine"),
    Params(uav=UAV, t=T, values={"NAVL1_PERIOD": 17.0}, complete=True, sentence="fine"),
    Model(
        uav=UAV,
        t=T,
        method="dynamics",
        verdict=VERDICT,
        in_force=VERDICT,
        longitudinal=_linear(("u", "w", "q", "theta"), ("delta_e", "delta_t")),
        lateral=_linear(("phi", "psi", "p", "r", "v"), ("delta_a", "delta_r")),
        derivatives=DERIVATIVES,
        earned={"u": 0.75, "psi": 1.0},
        window_t0=T - 20.0,
        window_s=20.0,
        interpolated=0.05,
        wind_n=3.0,
        wind_e=-1.0,
    ),
    Prediction(
        uav=UAV,
        t=T,
        state=State.PREDICTING,
        method="dynamics",
        law="arduplane: L1 + TECS",
        origin=(-353632620, 1491652370, 584000),
        ahead=Array.of([0.0, 1.0, 2.0]),
        path=Array.of(np.arange(9).reshape(3, 3)),
        tube=Array.of(np.full((3, 3), 2.0)),
        quantile=0.9,
        horizon_s=2.0,
        horizon_open=True,
        held=0.875,
        held_n=8,
        calibration="calibrated on 288 predictions of 16 flights",
        coast_s=0.5,
        seq=3,
        sentence="as far as the mission goes",
        event=Event.PARAMETERS,
        event_t=T - 2.0,
        event_said="NAVL1_PERIOD is 17, it was 20",
        controller=Controller(
            law="arduplane: L1 + TECS",
            received={"NAVL1_PERIOD": 17.0},
            identified={"WP_RADIUS": 80.0},
            default={"TECS_TIME_CONST": 5.0},
            asked={"AIRSPEED_CRUISE": 18.0},
        ),
    ),
    Mismatch(
        uav=UAV,
        t=T,
        outcome=Found.NAMED,
        causes=(
            Cause(
                name="actuator_lag",
                channel="actuator",
                surface="elevator",
                rivals=("actuator_delay",),
                segments=((T - 10.0, T - 5.0),),
                parameters={"tau_s": 0.25},
                sigma={"tau_s": 0.01},
            ),
        ),
        fit_before=1.9,
        fit_after=1.1,
        force_before=0.4,
        force_after=0.2,
        stray_before=6.1,
        stray_after=2.2,
        seen_t0=T - 120.0,
        adapted=True,
        sentence="the elevator follows more slowly",
    ),
    Alert(
        uav=UAV,
        t=T,
        kind=AlertKind.CONFLICT,
        active=True,
        sentence="uav 8 in 12 s",
        other=8,
        probability=0.75,
        at=T + 12.0,
        lat=474_000_000,
        lon=85_000_000,
        alt=550_000,
    ),
    FleetState(t=T, rows=(ROW,), sentence="compiling the twin's physics, once"),
    Account(
        t=T,
        links=("udpin:0.0.0.0:14550",),
        uavs=(UAV,),
        datagrams=10,
        bytes_in=1000,
        messages=20,
        bad_bytes=3,
        bad_frames=2,
        refused={"stale": 1},
        published=15,
        sentence="fine",
    ),
)
EXAMPLES = {type(message): message for message in MESSAGES}
