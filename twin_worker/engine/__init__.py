"""How often what is worked out, and what gives way first where a core cannot keep up."""
