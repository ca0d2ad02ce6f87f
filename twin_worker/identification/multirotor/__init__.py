"""Identification of the rotor model of a multirotor: thrust, drag, motor lag, torque effectiveness, wind."""
