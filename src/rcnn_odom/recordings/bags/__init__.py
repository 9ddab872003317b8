"""Parts of the reader of ROS bags: files, messages, topics, point clouds, and the robot under the laser."""
