"""One file per dialect: a table whose rows lead from a message to the columns of a `Sample`."""
