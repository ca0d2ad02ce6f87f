"""Ownership of UAV ids among workers: claims with epochs, handover, takeover."""
