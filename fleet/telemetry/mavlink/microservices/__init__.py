"""MAVLink's parameter and mission protocols, and the resulting mission."""
