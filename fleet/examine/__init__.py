"""What `fleet doctor` looks at: this machine, the door of the bus, and the fleet behind it."""
