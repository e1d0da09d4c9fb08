"""Places of a LiDAR, recognised without a guess of where they are."""
