"""The verbs of the `fleet` command, one a file."""
