"""The concealer of a blind examination: it flies JSBSim flights and hides in some what no simulation of theirs knows.

    effects      THE TABLE of what may be hidden, on which airframe, how large
    roles        how many flights hide nothing, one effect, two, one that no catalogue lists; which effects go together
    paths        missions of an examination, and the test pilot's inputs
    plan         one planned flight: aircraft, mission, weather, what is hidden since when
    record       fly it, with and without what is hidden; keep it in a sane envelope
    acts         does it act: the difference over the noise
    truth        what is hidden in the units a report uses, by JSBSim's own account
    cards        what an operator knows of the aircraft
    exam         the whole examination

The effects are JSBSim's own physics, and faults of servos and sensors; nothing of the twin's effects, simulation or
diagnosis is imported: one code must never both conceal and find.
"""
