"""MAVLink's parameter and mission protocols, and the route that follows from them."""
