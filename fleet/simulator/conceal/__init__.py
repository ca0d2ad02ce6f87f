"""Simulation of blind test flights with JSBSim, some with hidden effects.

    effects      table of the hidden effects: airframe, channel, time profile, magnitude; their values in a report
    paths        one planned flight: aircraft, mission, test pilot, weather, hidden effects and their onset
    record       simulate a flight with and without the effects; check the flight envelope
    acts         strength of an effect: difference over sensor noise
    exam         all flights of a blind test: number of flights of each role, separable effects, airframe data, labels

The effects come from JSBSim and from faults of servos and sensors. The package imports nothing from the effects,
simulation or diagnosis of the twin, so that the same code never both conceals and identifies an effect.
"""
