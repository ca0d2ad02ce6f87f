"""Simulation of blind test flights with JSBSim, some with hidden effects.

    effects      table of the hidden effects: airframe, channel, time profile, magnitude
    roles        number of flights with no, one, two or one uncatalogued effect; which effects are separable
    paths        missions of the blind test, and the inputs of the test pilot
    plan         one planned flight: aircraft, mission, weather, hidden effects and their onset
    record       simulate a flight with and without the effects; check the flight envelope
    acts         strength of an effect: difference over sensor noise
    truth        true parameters in the units of a report, from the draw or from JSBSim
    cards        airframe data that an operator has
    exam         all flights of a blind test

The effects come from JSBSim and from faults of servos and sensors. The package imports nothing from the effects,
simulation or diagnosis of the twin, so that the same code never both conceals and identifies an effect.
"""
