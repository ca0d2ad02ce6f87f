"""What must be refused, tried: at the door, by role, by size, and with messages made to hurt whoever reads them."""
