"""Faults concealed in recorded flights: the recorded motion is kept, inputs and readings are altered.

    recorded     read a recording into arrays, write the altered copy as a fleet recording
    thrust       the thrust curve that a flight shows
    faults       inputs and readings of the faulty aircraft that flies the recorded motion
    injector     process that draws faults, writes the recordings and encrypts the labels

Principle: the motion of a recording is a fact. A faulty aircraft that flies the same motion needs the same forces and
moments, so its autopilot must have commanded something else, and its sensors must have reported something else. With
a loss of effectiveness the command is delta / (1 - loss), with an offset delta - offset, with a delay
delta(t + delay), with a loss of thrust the throttle at which (1 - loss) T(delta_t, Va) equals the recorded thrust.
The motion, the wind and the noise of the real flight remain. A fault whose command exceeds the range of its output
could not have flown this motion and is drawn again.
"""
