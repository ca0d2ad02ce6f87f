"""The 3D scene: aircraft, routes, predictions, prediction regions."""
