"""Blind test flights of multirotors on RotorPy: effects by its own parameters and by faults of the sensors.

faults   table of the hidden effects; parameters of RotorPy and readings with them
exam     all flights of a blind test: aircraft, missions, weather, effects, strength, labels
"""
