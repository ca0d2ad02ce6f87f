"""Reader of ROS 2 bags (MCAP, SQLite) of MAVROS and px4_msgs."""
