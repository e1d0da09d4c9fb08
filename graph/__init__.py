"""Composing operators to graphs, and running them."""
