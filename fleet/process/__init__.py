"""What every process needs: Ctrl-C, children, logs, private files, memory given back, untrusted text."""
