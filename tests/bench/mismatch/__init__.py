"""How soon a fault is found in a flying aircraft, and what that is worth to its predictions."""
