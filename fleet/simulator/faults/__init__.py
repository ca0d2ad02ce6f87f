"""Faults of a simulated aircraft: servos, sensors and JSBSim physics.

    fault        one fault: name, part, values, onset
    servos       servo response to a command, after the telemetry of the command
    sensing      errors of the estimate that the autopilot uses and reports
    physics      air, engine and airframe, changed through JSBSim properties
    kinds        table of the faults, and their syntax on the command line
    carried      all faults of one aircraft, the interface for `SimulatedUav`

The package uses nothing from the effects of the twin, so that the same code never both conceals and identifies.
"""
