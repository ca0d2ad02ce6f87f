"""The Zenoh bus: sessions, encoding, presence, fencing by epoch, and an in-memory double for tests."""
