"""The worker process: threads, queries, metrics, warm-up."""
