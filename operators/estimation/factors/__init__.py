"""What an edge of each kind says, as a factor of the problem."""
