"""Trained networks: where they come from, how they are run, and the operators that use them."""
