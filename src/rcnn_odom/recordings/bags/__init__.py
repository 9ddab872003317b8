"""What a ROS bag holds: its files, their messages, the choice of a topic, and point clouds."""
