"""What flows between operators and what it flows through."""
