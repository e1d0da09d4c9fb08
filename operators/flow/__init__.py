"""Operators that choose among messages, whatever they say."""
