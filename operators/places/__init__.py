"""Places seen before: found by what they look like, and by where that puts the robot."""
