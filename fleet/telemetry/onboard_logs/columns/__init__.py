"""Reader of tables (CSV, MATLAB) by a column map."""
