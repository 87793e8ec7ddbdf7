"""The demo: runs simulator, router and ROS nodes on this computer, and checks that messages arrive."""
