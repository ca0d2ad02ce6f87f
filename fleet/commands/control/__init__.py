"""Commands with which a person acts on aircraft."""
