"""ROS 2: estimates as messages, recordings of them, a live node. What needs rosbags or rclpy imports it when used."""
