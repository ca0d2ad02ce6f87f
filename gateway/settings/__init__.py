"""Link specifications from the command line, and which messages a link carries."""
