"""Links to bus: MAVLink in, Samples out."""
