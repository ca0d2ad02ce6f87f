"""Reader of PX4 ULog files."""
