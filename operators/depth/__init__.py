"""What depth images alone tell."""
