"""Tables from MAVLink, DataFlash and ULog messages to the columns of a `Sample`, and the shared clock."""
