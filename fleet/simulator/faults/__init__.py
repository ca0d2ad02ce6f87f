"""Faults of a simulated aircraft: servos, sensors and JSBSim physics.

    servos       servo response to a command, after the telemetry of the command
    physics      one fault in time; air, engine and airframe, changed through JSBSim properties
    carried      errors of the estimate; all faults of one aircraft, the interface for `SimulatedUav`
    kinds        table of the faults, and their syntax on the command line

The package uses nothing from the effects of the twin, so that the same code never both conceals and identifies.
"""
