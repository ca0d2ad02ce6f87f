"""Rotor model of multirotors, identified online from motor outputs, commanded attitude and velocities."""
