"""The simulated airframe: JSBSim model, sensors, weather and mission of one aircraft."""
