"""Access to the bus: credentials, roles, permissions and message size limits."""
