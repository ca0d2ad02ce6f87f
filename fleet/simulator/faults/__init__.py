"""Faults a pretend aircraft may carry: of its servos, of its sensors, of the physics JSBSim flies.

    fault        one fault: what, of which part, how much, since when
    servos       what a servo makes of its command, after the telemetry has told the command
    sensing      what a sensor makes of the truth: the autopilot flies on it and reports it
    physics      what the air, the engine or the airframe does, by JSBSim's own properties
    kinds        the table of them, and how one is written on a command line
    carried      all faults of one aircraft: the one thing `PretendUav` knows of

Nothing of the twin's own effects is used here: one code must never both conceal and find.
"""
