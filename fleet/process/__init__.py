"""Functions of every process: Ctrl-C, child processes, logs, private files, return of freed memory, untrusted text."""
