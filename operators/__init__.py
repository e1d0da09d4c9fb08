"""The stages of a mapping graph."""
